/** The Experiments tab: checkpoints of a sweep as a sortable, filterable table and a scatter plot, and their episodes. */

/** @import { State, Store } from '../core/state.js' */
/** @import { Catalog, EpisodeResult, ExperimentRow, SweepInfo } from '../types/server.js' */
/** @import { Column } from './experiment_columns.js' */
/** @import { SeedGroup } from './experiment_groups.js' */

import { create, element, html, messageOf } from '../core/dom.js';
import { permalink } from '../core/state.js';
import { fixed, sentence, significant, stepLabel } from '../core/units.js';
import * as api from '../data/api.js';
import { emptyNote } from '../widgets/empty_note.js';
import { setPanelState } from '../widgets/panel_state.js';
import { navigateRows, setTabStop } from '../widgets/row_navigation.js';
import { sortHeading, sortRows } from '../widgets/sorting.js';
import {
  matching,
  NUMBER_KEYS,
  NUMBERS,
  parseSort,
  rowKey,
  sortText,
  valueOf,
  unknownConditions,
  comparedWith,
} from './experiment_rows.js';
import { columnsOf } from './experiment_columns.js';
import { cellOf, faultKinds, seedGroups } from './experiment_groups.js';
import { differingEntries, isAddress, isNumeric } from './experiment_provenance.js';
import { coloured, drawScatter, levelName, markPoint } from './scatter.js';

const EMPTY = {
  title: 'No sweep yet',
  paragraphs: [
    [
      'A sweep runs many checkpoints over many episodes. Its table shows which of them fail, where and under which sensor faults; each row opens its worst step.',
    ],
  ],
  purpose: 'To make one, run your checkpoints and serve the results.',
  commands: [
    "beliefscope sweep --checkpoints 'runs/*.safetensors' -o sweep",
    'beliefscope serve --sweep sweep',
  ],
};
const ROWS_AT_ONCE = 200; // drawn before the table is scrolled
const EPISODES = 50; // listed for a checkpoint, the worst first

const BODY = `
  <div class="top">
    <label class="picker">Sweep <select class="sweep" aria-label="Sweep"></select></label>
    <label class="picker" title="Mean over seeds: of the checkpoints whose training and provenance differ by seeds and addresses of runs only, with their standard deviation">Rows <select class="rows" aria-label="Rows"><option value="checkpoints">each checkpoint</option><option value="seeds">mean over seeds</option></select></label>
    <label class="picker">Steps <select class="steps" aria-label="Steps"></select></label>
    <label class="picker">Show <input class="match" type="search" placeholder="ekf blackout nees>2" aria-label="Words and conditions that rows must match" title="Words in any column, and conditions such as nees&gt;2"></label>
    <a class="csv" download>CSV</a>
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
    <ol></ol>
  </section>
  <p class="note"></p>`;

export class Experiments {
  #host;
  #catalog;
  #store;
  #open = false;
  /** @type {SweepInfo[] | null} */
  #sweeps = null;
  /** Rows of the sweep and steps in `#loaded`. @type {ExperimentRow[]} */
  #rows = [];
  /** Names of the columns with numbers. @type {string[]} */
  #numbers = [];
  /** Columns of the table. @type {Column[]} */
  #columns = [];
  /** Matching rows, in order. @type {(ExperimentRow | SeedGroup)[]} */
  #matching = [];
  #count = 0;
  #loaded = '';
  /** Episodes of the selected row. @type {EpisodeResult[]} */
  #episodes = [];
  /** Seed of the runs that the page opens. */
  #openedSeed = 0;
  #body;

  /**
   * @param {HTMLElement} host
   * @param {Catalog} catalog
   * @param {Store} store
   */
  constructor(host, catalog, store) {
    this.#host = host;
    this.#catalog = catalog;
    this.#store = store;
    host.innerHTML = BODY;
    this.#body = element('.checkpoints tbody', HTMLTableSectionElement, host);
    navigateRows(this.#body);
    const scroll = html('.scroll', host);
    scroll.addEventListener('scroll', () => {
      const below = scroll.scrollHeight - scroll.scrollTop - scroll.clientHeight;
      if (below < scroll.clientHeight) this.#addRows(ROWS_AT_ONCE);
    });
    new ResizeObserver(() => this.#drawChart()).observe(html('.chart', host));
    this.#listenToPickers();
    html('.compare', host).addEventListener('click', () =>
      this.#openRow((row, filter) => ({
        tab: 'compare',
        // the sensor faults are compared if the filter is the same
        against: comparedWith(row, filter, store.state.filter),
      })),
    );
    html('.diagnose', host).addEventListener('click', () =>
      this.#openRow((row, filter) => ({
        ...this.#runOf(row, filter),
        tab: 'diagnosis',
        over: 'held-out',
      })),
    );
    store.listen((_, changed) => {
      if (!this.#open) return;
      if (['sweep', 'steps'].some((key) => changed.has(key))) {
        this.#load();
        return;
      }
      if (['match', 'sort', 'x', 'y', 'rows', 'pinned'].some((key) => changed.has(key)))
        this.#draw();
      if (changed.has('cell') || changed.has('rows')) this.#showSelected();
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
    const pick = (/** @type {keyof State} */ key, /** @type {string} */ selector) => {
      const picker = element(selector, HTMLSelectElement, this.#host);
      picker.addEventListener('change', () => store.set({ [key]: picker.value }));
    };
    pick('sweep', '.sweep');
    pick('rows', '.rows');
    pick('steps', '.steps');
    pick('x', '.x');
    pick('y', '.y');
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
    if (!this.#sweeps) setPanelState(this.#host, 'loading', 'Loading …');
    try {
      const { sweeps, problems } = await api.sweeps();
      this.#sweeps = sweeps;
      html('.problems', this.#host).textContent = problems.map(sentence).join(' ');
      const sweep = this.#sweep;
      if (!sweep) {
        setPanelState(this.#host, 'empty');
        html('.note', this.#host).replaceChildren(...emptyNote(EMPTY));
        return;
      }
      const wanted = `${sweep.name} ${this.#steps}`;
      const { rows, count } = await api.experiments(sweep.name, this.#steps);
      if (wanted !== `${this.#sweep?.name} ${this.#steps}`) return; // another choice was made meanwhile
      [this.#rows, this.#count, this.#loaded] = [rows, count, wanted];
      const entries = differingEntries(rows).filter((name) => isNumeric(rows, name));
      this.#numbers = [...NUMBER_KEYS, ...entries];
      setPanelState(this.#host, 'ready');
      this.#fillPickers(sweep);
      this.#draw();
      this.#showSelected();
    } catch (error) {
      setPanelState(this.#host, 'error', messageOf(error));
    }
  }

  /** @param {SweepInfo} sweep */
  #fillPickers(sweep) {
    const { state } = this.#store;
    /** @type {Record<string, string>} */
    const titles = Object.fromEntries(NUMBER_KEYS.map((key) => [key, NUMBERS[key].title]));
    const kinds = faultKinds(this.#rows);
    for (const kind of kinds) titles[levelName(kind)] = `level of ${kind}`;
    const fill = (
      /** @type {string} */ selector,
      /** @type {string[]} */ names,
      /** @type {string} */ value,
    ) => {
      const picker = element(selector, HTMLSelectElement, this.#host);
      picker.replaceChildren(...names.map((name) => new Option(titles[name] ?? name, name)));
      picker.value = value;
      return picker;
    };
    const names = (this.#sweeps ?? []).map(({ name }) => name);
    const picker = fill('.sweep', names, sweep.name);
    if (picker.parentElement) picker.parentElement.hidden = names.length < 2;
    fill('.steps', ['all', ...sweep.phases.filter((name) => name !== 'all')], this.#steps);
    fill('.x', [...this.#numbers, ...kinds.map(levelName)], state.x);
    fill('.y', this.#numbers, state.y);
    element('.rows', HTMLSelectElement, this.#host).value = state.rows;
    element('.match', HTMLInputElement, this.#host).value = state.match;
    element('.csv', HTMLAnchorElement, this.#host).href = api.experimentsCsv(
      sweep.name,
      this.#steps,
    );
  }

  #draw() {
    const { state } = this.#store;
    const sort = parseSort(state.sort);
    const matched = matching(this.#rows, state.match);
    const groups = state.rows === 'seeds' ? seedGroups(matched) : matched;
    const rows = sortRows(groups, (row) => valueOf(row, sort.name), sort.down);
    const more = this.#count > this.#rows.length ? `, ${this.#rows.length} are listed` : '';
    html('.about', this.#host).textContent =
      unknownConditions(state.match, this.#numbers) ||
      `${matched.length} of ${this.#rows.length} results of ${this.#sweep?.checkpoints ?? 0} checkpoints match${more}.`;
    const pinned = pinnedColumns(state);
    const columns = columnsOf(this.#rows, state.rows === 'seeds', pinned);
    const heads = columns.map(({ key, title, help, number }, i) => {
      const head = sortHeading(
        { name: key, title, help, number },
        sort,
        (next) => this.#store.set({ sort: sortText(next) }),
        number,
      );
      if (i > 0) head.append(this.#pinButton(key, title, pinned));
      return head;
    });
    element('.checkpoints thead', HTMLTableSectionElement, this.#host).replaceChildren(
      create('tr', {}, ...heads),
    );
    this.#body.replaceChildren();
    this.#matching = rows;
    this.#columns = columns;
    this.#addRows(ROWS_AT_ONCE);
    this.#drawChart();
    this.#mark();
  }

  /**
   * Adds the next rows to the table, which has the first ones until it is scrolled.
   * @param {number} count
   */
  #addRows(count) {
    const drawn = this.#body.rows.length;
    const filters = this.#filters;
    const lines = this.#matching
      .slice(drawn, drawn + count)
      .map((row) => this.#tableRow(row, filters));
    this.#body.append(...lines);
    if (lines.length) this.#stick();
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

  /**
   * @param {string} key
   * @param {string} title
   * @param {string[]} pinned
   */
  #pinButton(key, title, pinned) {
    const isPinned = pinned.includes(key);
    const button = create('button', { type: 'button', className: 'quiet pin', textContent: '⇤' });
    button.title = isPinned ? 'Release this column' : 'Keep this column at the left';
    button.ariaLabel = `Pin ${title}`;
    button.ariaPressed = String(isPinned);
    button.addEventListener('click', () => {
      const others = pinned.filter((name) => name !== key);
      const names = isPinned ? others : [...others, key];
      this.#store.set({ pinned: names.map(encodeURIComponent).join() });
    });
    return button;
  }

  /** Keeps the first column and those pinned at the left of the table when it scrolls. */
  #stick() {
    const pinned = pinnedColumns(this.#store.state);
    const count = this.#columns.filter(({ key }) => pinned.includes(key)).length;
    const lines = [...element('.checkpoints', HTMLTableElement, this.#host).rows];
    const widths = [...lines[0].cells].slice(0, count).map((cell) => cell.offsetWidth);
    for (const line of lines)
      widths.reduce((left, width, i) => {
        const cell = line.cells[i + 1];
        cell.classList.add('pinned');
        cell.style.left = `${left + width}px`;
        return left + width;
      }, 0);
  }

  /** Names of all filters; their order sets the colours. */
  get #filters() {
    return [...new Set(this.#rows.map(({ filter }) => filter))];
  }

  /**
   * @param {ExperimentRow | SeedGroup} row
   * @param {string[]} filters their order sets the colours
   */
  #tableRow(row, filters) {
    const button = create('button', { type: 'button', className: 'quiet', textContent: row.name });
    button.title = `${row.name}: its worst episodes`;
    const dot = coloured(create('span', { className: 'dot' }), row, filters);
    const line = create('tr', {}, create('th', { scope: 'row' }, dot, button));
    line.dataset.cell = cellOf(row);
    line.addEventListener('click', () => this.#select(row)); // also clicks on the button, which serves the keyboard
    for (const { content, number } of this.#columns.slice(1)) {
      const cell = line.insertCell();
      cell.className = number ? 'number' : '';
      const text = content(row);
      if (isAddress(text)) cell.append(externalLink(text));
      else cell.textContent = text;
    }
    return line;
  }

  /** @param {ExperimentRow | SeedGroup} row */
  #select(row) {
    const cell = cellOf(row);
    this.#store.set({ cell: cell === this.#store.state.cell ? '' : cell });
  }

  /** @returns {ExperimentRow | undefined} */
  get #selected() {
    return this.#rows.find((row) => rowKey(row) === this.#store.state.cell);
  }

  #mark() {
    const { cell } = this.#store.state;
    const missing = this.#matching.findIndex((row) => cellOf(row) === cell) + 1;
    this.#addRows(Math.max(0, missing - this.#body.rows.length));
    for (const line of this.#body.rows) {
      const here = line.dataset.cell === cell;
      line.classList.toggle('here', here);
      if (here) setTabStop(line, false);
    }
    markPoint(html('.chart', this.#host), cell);
  }

  /** Lists the episodes of the selected checkpoint, or the checkpoints of the selected group. */
  async #showSelected() {
    this.#mark();
    const { cell } = this.#store.state;
    const group = this.#matching.find((row) => cellOf(row) === cell);
    const row = this.#selected;
    const [sweep, section] = [this.#sweep, html('.episodes', this.#host)];
    const members = group && 'members' in group ? group.members : null;
    section.hidden = !row && !members;
    for (const button of ['.compare', '.diagnose']) html(button, section).hidden = Boolean(members);
    if (group && members) this.#showMembers(group.name, members);
    if (!row || !sweep) return;
    try {
      const { episodes, opened_seed: seed } = await api.experimentEpisodes(
        sweep.name,
        row,
        this.#steps,
      );
      if (row !== this.#selected) return;
      [this.#episodes, this.#openedSeed] = [episodes, seed];
    } catch (error) {
      html('.problems', this.#host).textContent = messageOf(error);
      return;
    }
    const faults = row.faults && `, ${row.faults}`;
    html('.episodes h4', this.#host).textContent =
      `${row.name}${faults}: ${this.#episodes.length} results, the worst first`;
    const items = this.#episodes
      .slice(0, EPISODES)
      .map((episode) => this.#episodeItem(row, episode));
    html('.episodes ol', this.#host).replaceChildren(...items);
  }

  /**
   * Lists the checkpoints of a group.
   * @param {string} name
   * @param {ExperimentRow[]} members
   */
  #showMembers(name, members) {
    const faults = members[0].faults && `, ${members[0].faults}`;
    html('.episodes h4', this.#host).textContent =
      `${name}${faults}: mean of ${members.length} checkpoints, the worst first`;
    const items = sortRows(members, ({ error }) => error, true).map((row) => {
      const button = create('button', { type: 'button', className: 'text' }, row.name);
      button.addEventListener('click', () =>
        this.#store.set({ rows: 'checkpoints', cell: rowKey(row) }),
      );
      const values = `RMSE ${fixed(row.error, 2)} ${row.unit}, NEES ${significant(row.nees)}`;
      return create('li', {}, button, create('span', { textContent: values }));
    });
    html('.episodes ol', this.#host).replaceChildren(...items);
  }

  /**
   * @param {ExperimentRow} row
   * @param {EpisodeResult} result
   */
  #episodeItem(
    row,
    { episode, seed, error, unit, worst, worst_step: step, worst_time: time, nees, policy },
  ) {
    const textContent = `Episode ${episode}, ${stepLabel(step, time)}`;
    const patch = (/** @type {string} */ filter) => ({
      ...this.#runOf(row, filter),
      episode,
      step,
      tab: 'scene',
    });
    const isOpened = seed === this.#openedSeed;
    const link = create(isOpened ? 'a' : 'span', { textContent });
    if (link instanceof HTMLAnchorElement) {
      link.href = permalink({ ...this.#store.state, ...patch(filterName(row)) });
      link.addEventListener('click', (event) => {
        if (event.ctrlKey || event.metaKey || event.shiftKey) return;
        event.preventDefault();
        this.#openRow((_, filter) => patch(filter));
      });
    } else link.title = `This server runs seed ${this.#openedSeed}: serve with --seed ${seed}`;
    const values = [`RMSE ${fixed(error, 2)} ${unit}`, `worst ${fixed(worst, 2)} ${unit}`];
    if (nees !== null) values.push(`NEES ${significant(nees)}`);
    if (!isOpened) values.push(`seed ${seed}, not of this server`);
    return create(
      'li',
      {},
      link,
      create('span', { textContent: [...values, policy].filter(Boolean).join(', ') }),
    );
  }

  /**
   * The displayed run of a row.
   * @param {ExperimentRow} row
   * @param {string} filter its name in the catalog
   * @returns {Partial<State>}
   */
  #runOf({ task, faults, data_name: data, worst_episode: episode, worst_step: step }, filter) {
    const names = this.#catalog.tasks.find(({ name }) => name === task);
    const place = { episode: episode ?? 0, step: step ?? 0, against: '', playing: false };
    return { task, filter, faults, data: data ?? names?.data[0]?.name ?? '', ...place };
  }

  /**
   * Opens the selected checkpoint, which is added to the catalog if necessary.
   * @param {(row: ExperimentRow, filter: string) => Partial<State>} patch
   */
  async #openRow(patch) {
    const [row, sweep] = [this.#selected, this.#sweep];
    if (!row || !sweep) return;
    if (!row.data_name) {
      html('.problems', this.#host).textContent =
        `This server does not have the episodes of ${row.name} (data ${row.data.slice(0, 12)}): serve them with --data.`;
      return;
    }
    if (row.catalog_name) {
      this.#store.set(patch(row, row.catalog_name));
      return;
    }
    try {
      const filter = this.#catalog.read_only
        ? filterName(row)
        : (await api.addSweepFilter(sweep.name, row.checkpoint)).filter;
      // Loads the catalog again.
      location.assign(`/${permalink({ ...this.#store.state, ...patch(row, filter) })}`);
    } catch (error) {
      html('.problems', this.#host).textContent = messageOf(error);
    }
  }
}

/**
 * Name of a row's filter in the catalog; one that is not listed yet is added when the page opens with this name.
 * @param {ExperimentRow} row
 */
const filterName = ({ catalog_name, name, checkpoint }) =>
  catalog_name ?? `${name}-${checkpoint.slice(0, 8)}`;

/** @param {string} address */
function externalLink(address) {
  const textContent = address.replace(/^https?:\/\//, '');
  const link = create('a', { href: address, target: '_blank', rel: 'noopener', textContent });
  link.addEventListener('click', (event) => event.stopPropagation()); // does not select the row
  return link;
}

/** Keys of the pinned columns, which may contain commas. @param {State} state */
const pinnedColumns = ({ pinned }) => pinned.split(',').filter(Boolean).map(decodeURIComponent);
