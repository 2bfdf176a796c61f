/** The Experiments tab: its choices, and the loading of results for the table, the scatter plot and the list of episodes. */

/** @import { Store } from '../core/state.js' */
/** @import { ExperimentRow, SweepInfo } from '../types/server.js' */
/** @import { Column } from './experiment_columns.js' */
/** @import { SeedGroup } from './experiment_groups.js' */

import { element, html, messageOf, setOptions } from '../core/dom.js';
import { download } from '../core/download.js';
import { plural, sentence } from '../core/units.js';
import * as api from '../data/api.js';
import { emptyNote } from '../widgets/empty_note.js';
import { setPanelError, setPanelState } from '../widgets/panel_state.js';
import { sortRows } from '../widgets/sorting.js';
import { entryColumns, tableLayout } from './experiment_columns.js';
import { tableCsv } from './experiment_csv.js';
import { EpisodePanel } from './experiment_episodes.js';
import { matching } from './experiment_filter.js';
import { GroupMenu, namesText } from './experiment_group_menu.js';
import { cellOf, faultKinds, seedGroups } from './experiment_groups.js';
import { isNumeric } from './experiment_provenance.js';
import {
  numbersOf,
  parseSort,
  rowKey,
  sortText,
  sortValue,
  unknownChoice,
} from './experiment_rows.js';
import { ExperimentTable } from './experiment_table.js';
import { drawScatter, levelName, markPoint } from './scatter.js';

const EMPTY = {
  title: 'No sweep yet',
  paragraphs: [
    [
      'A sweep runs many checkpoints over many episodes. Its table shows which of them fail, where and under which sensor faults; each row opens its worst step.',
    ],
  ],
  purpose: 'To create one, run your checkpoints and serve the results.',
  commands: [
    "beliefscope sweep --checkpoints 'runs/*.safetensors' -o sweep",
    'beliefscope serve --sweep sweep',
  ],
};
const LOADING_DELAY = 150; // ms until a panel with contents shows that it loads

const BODY = `
  <div class="top">
    <label class="picker">Sweep <select class="sweep" aria-label="Sweep"></select></label>
    <label class="picker" title="Mean over seeds: of the checkpoints with equal filter, training and grouping entries of the provenance, with their standard deviation">Rows <select class="rows" aria-label="Rows"><option value="checkpoints">each checkpoint</option><option value="seeds">mean over seeds</option></select></label>
    <button type="button" class="group-by text" popovertarget="experiment-groups" aria-haspopup="dialog" title="Entries of the provenance that distinguish groups of checkpoints" hidden></button>
    <label class="picker">Steps <select class="steps" aria-label="Steps"></select></label>
    <label class="picker">Show <input class="match" type="search" placeholder="ekf blackout nees > 2" aria-label="Words and conditions that rows must match" title="Words in any column, and conditions with &gt; &lt; &gt;= &lt;= = or !=, such as nees &gt; 2 or seed = 1. Quote names and texts with spaces: &quot;95 % coverage&quot; &lt; 90%"></label>
    <button type="button" class="csv text quiet" title="Download the displayed rows and columns, with all digits">CSV</button>
  </div>
  <p class="problems" role="alert"></p>
  <div class="axes">
    <p class="about" role="status"></p>
    <label class="picker">x <select class="x" aria-label="Quantity of the x axis"></select></label>
    <label class="picker">y <select class="y" aria-label="Quantity of the y axis"></select></label>
  </div>
  <div class="chart"></div>
  <div class="scroll" tabindex="-1"><table class="checkpoints"><thead></thead><tbody></tbody></table></div>
  <section class="episodes" aria-label="Episodes of the selected checkpoint" hidden>
    <div class="bar"><h4></h4><button type="button" class="compare">Compare with it</button><button type="button" class="diagnose">Diagnose</button></div>
    <p class="seeds"></p>
    <ol></ol>
  </section>
  <p class="note"></p>
  <div id="experiment-groups" class="group-menu" popover role="dialog" aria-label="Entries that distinguish groups">
    <p>Checkpoints with equal values of the selected entries, filter and training are one group.</p>
    <p class="none">No entry of the provenance differs.</p>
    <ul></ul>
    <button type="button" class="reset">Default</button>
  </div>`;

export class Experiments {
  #host;
  #store;
  #open = false;
  /** @type {SweepInfo[] | null} */
  #sweeps = null;
  /** Rows of the displayed sweep and steps. @type {ExperimentRow[]} */
  #rows = [];
  /** Names of the columns with numbers. @type {string[]} */
  #numbers = [];
  /** Matching rows, in order. @type {(ExperimentRow | SeedGroup)[]} */
  #matching = [];
  #layout = tableLayout();
  #count = 0;
  /** Sweeps that cannot be read, one sentence each. @type {string[]} */
  #problems = [];
  /** Number of requested loads; the answers to all but the last one are ignored. */
  #loads = 0;
  #loadingTimer = 0;
  #episodes;
  #groupMenu;
  #table;

  /**
   * @param {HTMLElement} host
   * @param {Store} store
   */
  constructor(host, store) {
    this.#host = host;
    this.#store = store;
    host.innerHTML = BODY;
    this.#table = new ExperimentTable(html('.scroll', host), {
      select: (row) => this.#select(row),
      sort: (next) => store.set({ sort: sortText(next) }),
      pin: (names) => store.set({ pinned: namesText(names) }),
    });
    new ResizeObserver(() => this.#drawChart()).observe(html('.chart', host));
    this.#listenToPickers();
    this.#episodes = new EpisodePanel(html('.episodes', host), store, (problem) =>
      this.#report(problem),
    );
    this.#groupMenu = new GroupMenu(host, (groups) => store.set({ groups }));
    store.listen((_, changed) => {
      /** @param {...string} keys */
      const any = (...keys) => keys.some((key) => changed.has(key));
      if (!this.#open) return;
      if (any('sweep', 'steps')) return this.#load();
      if (any('match', 'sort', 'x', 'y', 'rows', 'groups', 'pinned')) this.#draw();
      if (any('cell', 'rows', 'groups')) this.#showSelected();
    });
  }

  /** Whether the tab is selected. */
  set open(/** @type {boolean} */ open) {
    const opened = open && !this.#open;
    this.#open = open;
    if (opened) this.#load();
  }

  /** Draws the chart again in the colours of the theme. */
  redraw() {
    if (this.#open && this.#rows.length) this.#draw();
  }

  #listenToPickers() {
    const store = this.#store;
    for (const key of ['sweep', 'rows', 'steps', 'x', 'y']) {
      const picker = element(`.${key}`, HTMLSelectElement, this.#host);
      picker.addEventListener('change', () => store.set({ [key]: picker.value }));
    }
    html('.csv', this.#host).addEventListener('click', () => this.#saveCsv());
    const match = element('.match', HTMLInputElement, this.#host);
    match.addEventListener('input', () => store.set({ match: match.value }));
  }

  /** The selected sweep, or the first one. @returns {SweepInfo | undefined} */
  get #sweep() {
    return this.#sweeps?.find(({ name }) => name === this.#store.state.sweep) ?? this.#sweeps?.[0];
  }

  get #steps() {
    const { steps } = this.#store.state;
    return this.#sweep?.phases.includes(steps) ? steps : 'all';
  }

  async #load() {
    const load = ++this.#loads;
    clearTimeout(this.#loadingTimer);
    const showLoading = () => setPanelState(this.#host, 'loading', 'Loading …');
    if (!this.#sweeps || this.#host.dataset.state === 'error') showLoading();
    else this.#loadingTimer = setTimeout(showLoading, LOADING_DELAY);
    try {
      const { sweeps, problems } = await api.sweeps();
      if (load !== this.#loads) return; // another choice was made
      this.#sweeps = sweeps;
      this.#problems = problems.map(sentence);
      this.#report(this.#problems.join(' '));
      const sweep = this.#sweep;
      if (!sweep) {
        setPanelState(this.#host, 'empty');
        html('.note', this.#host).replaceChildren(...emptyNote(EMPTY));
        return;
      }
      const { rows, count } = await api.experiments(sweep.name, this.#steps);
      if (load !== this.#loads) return;
      [this.#rows, this.#count] = [rows, count];
      const { entries } = entryColumns(rows, []);
      this.#numbers = [
        ...Object.keys(numbersOf(rows)),
        ...entries.filter((name) => isNumeric(rows, name)),
      ];
      setPanelState(this.#host, 'ready');
      this.#fillPickers(sweep);
      this.#draw();
      this.#showSelected();
    } catch (error) {
      if (load !== this.#loads) return;
      setPanelError(this.#host, messageOf(error), () => this.#load());
    } finally {
      if (load === this.#loads) clearTimeout(this.#loadingTimer);
    }
  }

  /** @param {SweepInfo} sweep */
  #fillPickers(sweep) {
    const { state } = this.#store;
    /** @type {Record<string, string>} */
    const titles = Object.fromEntries(
      Object.entries(numbersOf(this.#rows)).map(([key, { title }]) => [key, title]),
    );
    const kinds = faultKinds(this.#rows);
    for (const kind of kinds) titles[levelName(kind)] = `level of ${kind}`;
    const fill = (
      /** @type {string} */ selector,
      /** @type {string[]} */ names,
      /** @type {string} */ value,
    ) => {
      const picker = element(selector, HTMLSelectElement, this.#host);
      setOptions(
        picker,
        names.map((name) => [name, titles[name] ?? name]),
        value,
      );
      return picker;
    };
    const names = (this.#sweeps ?? []).map(({ name }) => name);
    const picker = fill('.sweep', names, sweep.name);
    if (picker.parentElement) picker.parentElement.hidden = names.length < 2;
    fill('.steps', ['all', ...sweep.phases.filter((name) => name !== 'all')], this.#steps);
    const axis = (/** @type {'x' | 'y'} */ key, /** @type {string[]} */ quantities) =>
      fill(`.${key}`, quantities, quantities.includes(state[key]) ? state[key] : 'error');
    axis('x', [...this.#numbers, ...kinds.map(levelName)]);
    axis('y', this.#numbers);
    element('.rows', HTMLSelectElement, this.#host).value = state.rows;
    element('.match', HTMLInputElement, this.#host).value = state.match;
  }

  #draw() {
    const { state } = this.#store;
    const areGroups = state.rows === 'seeds';
    const { columns, entries, count, grouping, pinned } = this.#layout(this.#rows, state);
    const sort = parseSort(state.sort);
    const matched = matching(this.#rows, state.match);
    const groups = areGroups ? seedGroups(matched.rows, grouping) : matched.rows;
    const hasNumbers = this.#numbers.includes(sort.name);
    const rows = sortRows(groups, (row) => sortValue(row, sort.name, hasNumbers), sort.down);
    const more = this.#count > this.#rows.length ? `, ${this.#rows.length} are listed` : '';
    const cut =
      entries.length < count
        ? ` ${entries.length} of ${count} entries of the provenance are columns; Show and pinned columns use all.`
        : '';
    const checkpoints = this.#sweep?.checkpoints ?? 0;
    const about = html('.about', this.#host);
    about.classList.toggle('wrong', matched.problem !== '');
    about.textContent =
      matched.problem ||
      `${matched.rows.length} of ${this.#rows.length} results of ${plural(checkpoints, 'checkpoint')} match${more}.${areGroups ? '' : cut}`;
    this.#report([...this.#problems, ...this.#unknownChoices(columns)].join(' '));
    this.#groupMenu.show(this.#rows, state.groups, areGroups);
    this.#matching = rows;
    this.#table.draw({ rows, columns, pinned, sort, filters: this.#filters });
    this.#drawChart();
    this.#table.mark(state.cell);
  }

  /**
   * Reports choices of the address that this sweep does not have, and what is displayed instead.
   * @param {Column[]} columns
   */
  #unknownChoices(columns) {
    const { sweep, steps, x, y, sort } = this.#store.state;
    const levels = faultKinds(this.#rows).map(levelName);
    const sweeps = (this.#sweeps ?? []).map(({ name }) => name);
    const phases = this.#sweep?.phases ?? [];
    const keys = columns.map(({ key }) => key);
    const sorted = parseSort(sort).name;
    return [
      unknownChoice('Sweep', sweep, ['', ...sweeps], `the first sweep is displayed`),
      unknownChoice('Phase', steps, ['all', ...phases], 'all steps are displayed'),
      unknownChoice('Quantity', x, [...this.#numbers, ...levels], 'the x axis is RMSE'),
      unknownChoice('Quantity', y, this.#numbers, 'the y axis is RMSE'),
      unknownChoice('Column', sorted, [...keys, ...this.#numbers], 'the rows are not sorted'),
    ].filter(Boolean);
  }

  #drawChart() {
    const { x, y, cell } = this.#store.state;
    drawScatter(html('.chart', this.#host), this.#matching, {
      x,
      y,
      kinds: faultKinds(this.#rows),
      filters: this.#filters,
      select: (row) => this.#select(row),
    });
    markPoint(html('.chart', this.#host), cell);
  }

  /** Names of all filters; their order sets the colours. */
  get #filters() {
    return [...new Set(this.#rows.map(({ filter }) => filter))];
  }

  /** @param {ExperimentRow | SeedGroup} row */
  #select(row) {
    const cell = cellOf(row);
    this.#store.set({ cell: cell === this.#store.state.cell ? '' : cell });
  }

  /** Lists the episodes of the selected checkpoint, or the checkpoints of the selected group. */
  #showSelected() {
    const { cell } = this.#store.state;
    this.#table.mark(cell);
    markPoint(html('.chart', this.#host), cell);
    const group = this.#matching.find((row) => cellOf(row) === cell && 'members' in row);
    const row = this.#rows.find((other) => rowKey(other) === cell);
    this.#episodes.show(this.#sweep?.name ?? '', this.#steps, group ?? row);
  }

  #saveCsv() {
    const { columns } = this.#layout(this.#rows, this.#store.state);
    const csv = new Blob([tableCsv(this.#matching, columns)], { type: 'text/csv' });
    download(csv, `results-${this.#steps.replaceAll(' ', '-')}.csv`);
  }

  /** @param {string} problem */
  #report(problem) {
    html('.problems', this.#host).textContent = problem;
  }
}
