/** What studies found: every filter's error by share of black pictures, as bars and as a table, each a way to its worst moments. */

import * as api from '../data/api.js';
import { BarChart, legendSample, navigateLinks } from '../widgets/bar_chart.js';
import { jobSummary, isActive } from '../widgets/jobs.js';
import { setPanelState } from '../widgets/panel_state.js';
import { choice } from '../widgets/pickers.js';
import { permalink } from '../core/state.js';
import { fixed, percent, sentence, significant, displayName } from '../core/units.js';

const POSITION = 'position_cm';
const MORE = [
  {
    key: 'nees',
    title: 'NEES/n',
    help: 'With whole pictures: 1 where the covariance is right',
    shown: (value) => fixed(value, 2),
  },
  {
    key: 'coverage95',
    title: 'in 95 %',
    help: 'With whole pictures: how often the truth lies in the 95 % ellipsoid',
    shown: percent,
  },
  {
    key: 'seconds',
    title: 'training s',
    help: 'Mean over the seeds',
    shown: (value) => fixed(value, 0),
  },
];

const BODY = `
  <div class="top">
    <label class="of">Study <select aria-label="Study"></select></label>
    <div id="quantity" class="choice" role="radiogroup" aria-label="Quantity"></div>
  </div>
  <p class="about"></p>
  <p class="problems" role="status"></p>
  <div class="cells" role="status" hidden><progress max="1" aria-label="Progress of the study's cells"></progress><span></span> <button type="button" class="text">Train them</button></div>
  <div class="chart"></div>
  <p class="told" aria-hidden="true"></p>
  <div class="scroll" tabindex="-1"><table><thead></thead><tbody></tbody></table></div>
  <p class="note"></p>`;

/** @typedef {{name: string, preset: string, seeds: number, tasks: object[], unfinished: number, cells: number, job: string?, why_not: string}} Found a study, as the server tells it (docs/api.md) */

export class Study {
  #host;
  #store;
  #catalog;
  #failures;
  #jobs;
  #bars;
  #open = false;
  #studies = null;
  #heard = ''; // how its job was when the studies were asked for
  #problems = [];
  #sort = { by: 'filter', down: false };

  /**
   * @param {HTMLElement} host @param {api.Catalog} catalog @param {import('../core/state.js').Store} store
   * @param {import('./failures.js').Failures} failures that goes to the worst moment @param {import('../widgets/jobs.js').Jobs} jobs
   */
  constructor(host, catalog, store, failures, jobs) {
    [this.#host, this.#catalog, this.#store, this.#failures, this.#jobs] = [
      host,
      catalog,
      store,
      failures,
      jobs,
    ];
    host.innerHTML = BODY;
    this.#bars = new BarChart(this.#part('.chart'), (bar) => this.#tell(bar));
    const body = this.#part('tbody');
    navigateLinks(body);
    const look = ({ target }) => this.#bars.mark(target.closest('tr')?.dataset.filter ?? '');
    for (const kind of ['pointerover', 'focusin']) body.addEventListener(kind, look);
    for (const kind of ['pointerleave', 'focusout'])
      body.addEventListener(kind, () => this.#bars.mark(''));
    this.#part('select').addEventListener('change', ({ target }) =>
      store.set({ study: target.value }),
    );
    host.addEventListener('click', (event) => this.#click(event));
    this.#part('.cells button').addEventListener('click', () => this.#run());
    jobs.listen(() => this.#hear());
    store.listen(
      (_, changed) =>
        ['task', 'study', 'quantity', 'data'].some((key) => changed.has(key)) && this.#draw(),
    );
  }

  /** Whether the panel can be seen; nothing is asked for before. A study may go on: it is asked for each time. */
  set open(open) {
    if (open && !this.#open) this.#load();
    this.#open = open;
  }

  async #load() {
    if (!this.#studies) setPanelState(this.#host, 'loading', 'Loading …');
    try {
      ({ studies: this.#studies, problems: this.#problems } = await api.studies());
      this.#heard = this.#how;
      this.#draw();
    } catch (error) {
      setPanelState(this.#host, 'error', error.message);
    }
  }

  #part(selector) {
    return this.#host.querySelector(selector);
  }

  /** The study that is shown: the chosen one, or the first that has the task. @returns {Found} */
  get #study() {
    const { study, task } = this.#store.state;
    return (
      this.#studies.find(({ name }) => name === study) ??
      this.#studies.find(({ tasks }) => tasks.some(({ name }) => name === task)) ??
      this.#studies[0]
    );
  }

  /** The job that trains what is left of it. @returns {api.Job | undefined} */
  get #job() {
    return this.#jobs.find(this.#study.job);
  }

  /** How far that is. */
  get #how() {
    return `${this.#job?.state} ${this.#job?.progress}`;
  }

  #draw() {
    if (!this.#studies) return;
    const { state } = this.#store;
    const study = this.#study;
    const picker = this.#part('select');
    picker.replaceChildren(
      ...this.#studies.map(
        ({ name }) => new Option(name === 'shipped' ? 'the one that ships' : name, name),
      ),
    );
    picker.value = study.name;
    picker.parentElement.hidden = this.#studies.length < 2;
    this.#part('.problems').textContent = this.#problems.map(sentence).join(' ');
    this.#cells();
    const found = study.tasks.find(({ name }) => name === state.task);
    if (!found) {
      const others = study.tasks.map(({ name }) => name).join(', ');
      return setPanelState(
        this.#host,
        'empty',
        `This study has nothing on ${state.task}. It is of ${others}: choose another task${this.#studies.length > 1 ? ' or study' : ''}.`,
      );
    }
    const task = this.#catalog.tasks.find(({ name }) => name === state.task);
    const known = quantities(found, task);
    const quantity = known.find(({ key }) => key === state.quantity) ?? known[0];
    choice(
      this.#part('#quantity'),
      known.map(({ key, title }) => [key, title]),
      quantity.key,
      (key) => this.#store.set({ quantity: key }),
    );
    const groups = [
      ...new Set(found.rows.map((row) => row.blackout).filter((share) => share !== null)),
    ];
    const view = { study, found, task, quantity, groups };
    const rows = found.filters.map((filter) => this.#row(view, filter));
    this.#part('.about').textContent = about(view, rows);
    this.#chart(view, rows);
    this.#table(view, rows);
    setPanelState(this.#host, 'ready');
  }

  /** How many cells are left, and a button that has them trained; or how far that is, and one that ends it. */
  #cells() {
    const { unfinished, cells, why_not: whyNot } = this.#study;
    const [box, runs] = [this.#part('.cells'), this.#job && isActive(this.#job)];
    box.hidden = !unfinished && !runs;
    const [progress, text, button] = box.children;
    progress.hidden = !runs;
    progress.value = this.#job?.progress ?? 0;
    const ended = this.#job && !runs && this.#job.state !== 'done' ? ` ${jobSummary(this.#job)}` : '';
    const rest = `${unfinished} of ${cells} cells ${unfinished === 1 ? 'is' : 'are'} not trained yet.`;
    text.textContent = runs
      ? `Training cells: ${jobSummary(this.#job)}`
      : `${rest}${ended}${whyNot ? ` Not from here: ${sentence(whyNot)}` : ''}`;
    button.textContent = runs ? 'Cancel' : unfinished === 1 ? 'Train it' : 'Train them';
    button.hidden = !runs && Boolean(whyNot);
  }

  /** Has what is left trained, or no longer. */
  async #run() {
    if (this.#job && isActive(this.#job)) return this.#jobs.cancel(this.#job.id);
    try {
      const { job } = await api.trainStudy(this.#study.name);
      this.#study.job = job.id;
      await this.#jobs.refresh();
    } catch (error) {
      this.#part('.problems').textContent = error.message;
    }
  }

  /** Jobs have changed. After each cell, and at the end, there are other numbers. */
  #hear() {
    if (!this.#studies || !this.#open) return;
    this.#cells();
    if (this.#how === this.#heard) return;
    this.#heard = this.#how;
    this.#load();
  }

  /** All that is known of one filter: its bars, and the checkpoint that they open. */
  #row(view, { name, trained }) {
    const { found, groups, study } = view;
    const here =
      trained.find(({ catalog_name }) => catalog_name) ?? trained.find(({ file }) => file) ?? null;
    const lines = groups.map((blackout) =>
      found.rows.find((row) => row.filter === name && row.blackout === blackout),
    );
    const bars = lines.map((line) => this.#bar(view, line, here));
    return {
      name,
      study: study.name,
      here,
      lines,
      bars,
      seeds: lines[0].seeds,
      requested: lines[0].requested,
      failed: lines[0].failed,
    };
  }

  /** @returns {import('../widgets/bar_chart.js').Bar} */
  #bar({ quantity, task, study }, line, here) {
    const { key, unit } = quantity;
    const [mean, spread] = [line.mean[key] ?? null, line.spread[key] ?? null];
    const dots = Object.entries(line.by_seed).map(([seed, numbers]) => ({
      seed: Number(seed),
      value: numbers[key],
      here: Number(seed) === here?.seed,
    }));
    const known = dots.filter(({ value }) => value !== null && value !== undefined);
    const patch =
      here &&
      worstEvents(this.#store.state, task, here.catalog_name ?? '', line.blackout, quantity);
    const each = known.map(({ seed, value }) => `seed ${seed} ${fixed(value, 2)}`).join(', ');
    const number =
      mean === null
        ? line.failed
          ? 'failed'
          : 'missing'
        : `${fixed(mean, 2)}${spread === null ? '' : ` ± ${fixed(spread, 2)}`}${unit && ` ${unit}`}`;
    const opens = here
      ? `opens the worst events of seed ${here.seed}${here.catalog_name ? '' : ', which is put on the shelf'}`
      : 'its weights are not here';
    const label = `${line.filter}, ${black(line.blackout)}: ${number}${each && ` (${each})`}; ${opens}`;
    return {
      filter: line.filter,
      mean,
      spread,
      dots: known,
      label,
      href: patch && permalink({ ...this.#store.state, ...patch }),
      patch,
      here,
      study: study.name,
      task: task.name,
    };
  }

  #chart({ found, quantity, groups }, rows) {
    const trivial =
      found.rows.find(({ blackout }) => blackout === null)?.mean[quantity.key] ?? null;
    const level =
      quantity.key === 'nees'
        ? { name: 'consistent', value: 1 }
        : trivial === null
          ? null
          : { name: 'training mean', value: trivial };
    const host = this.#part('.chart');
    host.dataset.row = String(rows.length);
    this.#bars.show({
      label: `${quantity.long} by filter and share of black pictures`,
      unit: quantity.unit && `RMSE, ${quantity.unit}`,
      level,
      groups: groups.map((blackout, g) => ({
        name: black(blackout),
        bars: rows.map((row) => row.bars[g]),
      })),
    });
    this.#tell(null);
  }

  /** The bar that is looked at, in words; else what a bar is. */
  #tell(bar) {
    const rest =
      'Bars: mean over the seeds, with their standard deviation; a dot is a seed, the ringed one what a click opens.';
    this.#part('.told').textContent = bar ? `${bar.label}.` : rest;
    for (const row of this.#part('tbody').rows)
      row.classList.toggle('here', row.dataset.filter === bar?.filter);
  }

  #table({ quantity, groups, found, task }, rows) {
    const columns = [
      {
        by: 'filter',
        title: 'filter',
        help: 'In the order of the study',
        value: (row) => rows.indexOf(row),
      },
      ...groups.map((blackout, g) => ({
        by: `black ${g}`,
        title: `${black(blackout)}${g ? '' : quantity.unit && `, ${quantity.unit}`}`,
        help: quantity.long,
        value: (row) => row.bars[g].mean,
        bar: g,
      })),
      ...MORE.filter(({ key }) =>
        rows.some((row) => typeof row.lines[0].mean[key] === 'number'),
      ).map((more) => ({
        by: more.key,
        title: more.title,
        help: more.help,
        value: (row) => row.lines[0].mean[more.key] ?? null,
        shown: more.shown,
      })),
      {
        by: 'seeds',
        title: 'seeds',
        help: 'Finished, of those asked for',
        value: (row) => row.seeds,
        shown: (_, row) =>
          `${row.seeds} of ${row.requested}${row.failed ? `, ${row.failed} failed` : ''}`,
      },
    ];
    const sort = columns.some(({ by }) => by === this.#sort.by)
      ? this.#sort
      : { by: 'filter', down: false };
    const { value } = columns.find(({ by }) => by === sort.by);
    const ordered = [...rows].sort((a, b) => {
      const [one, other] = [value(a), value(b)];
      return one === null || other === null
        ? Number(one === null) - Number(other === null)
        : (sort.down ? -1 : 1) * (one - other);
    });
    const table = this.#part('table');
    table.setAttribute(
      'aria-label',
      `${quantity.long} of ${task.name}: mean over the seeds, and their standard deviation`,
    );
    const top = document.createElement('tr');
    top.append(...columns.map((column) => heading(column, sort)));
    this.#part('thead').replaceChildren(top);
    const body = this.#part('tbody');
    body.dataset.row = String(groups.length);
    body.replaceChildren(
      ...ordered.map((row) => line(columns, row)),
      ...training(found, quantity, columns),
    );
    body.querySelectorAll('a').forEach((link, i) => (link.tabIndex = i ? -1 : 0));
  }

  /** A bar or a number was clicked: its worst moments are opened; or a heading: the table is sorted. */
  #click(event) {
    const column = event.target.closest('th button')?.dataset.column;
    if (column) {
      this.#sort = { by: column, down: this.#sort.by === column ? !this.#sort.down : false };
      this.#draw();
      return this.#part(`[data-column='${column}']`).focus();
    }
    const { bar } = event.target.closest('a') ?? {};
    if (!bar?.patch || event.ctrlKey || event.metaKey || event.shiftKey) return;
    event.preventDefault();
    this.#go(bar);
  }

  async #go({ patch, here, study, task, filter }) {
    if (!here.catalog_name) {
      try {
        const opened = await api.addStudyFilter(study, task, filter, here.seed);
        location.assign(`/${permalink({ ...this.#store.state, ...patch, filter: opened.filter })}`); // the shelf is another one then
      } catch (error) {
        this.#part('.problems').textContent = error.message;
      }
      return;
    }
    this.#store.set({ ...patch, playing: false });
    this.#store.flush();
    this.#failures.worst();
  }
}

/** What can be shown of a task: errors by component, the place first, and whether the covariance is right. */
function quantities({ rows }, task) {
  const keys = new Set(rows.flatMap((row) => Object.keys(row.mean)));
  const errors = [...keys]
    .filter((key) => /_(cm|deg)$/.test(key))
    .sort((a, b) => Number(b === POSITION) - Number(a === POSITION));
  const place = displayName(task.map.x).replace(/(^| )x$/, '') || 'position';
  const shown = errors.map((key) => {
    const [, name, unit] = /^(.*)_(cm|deg)$/.exec(key);
    const title = key === POSITION ? place : displayName(name);
    return {
      key,
      component: name,
      title,
      unit: unit === 'deg' ? '°' : unit,
      long: `RMSE of ${key === POSITION ? 'the position' : title}`,
    };
  });
  const consistent = { key: 'nees', component: '', title: 'NEES', unit: '', long: 'NEES/n' };
  return rows.some((row) => typeof row.mean.nees === 'number') ? [...shown, consistent] : shown;
}

/** The page's state that shows where a filter fails under a share of black pictures, by what the quantity measures. */
function worstEvents(state, task, filter, blackout, { key, component }) {
  const turned = task.components.some(({ name, unit }) => name === component && unit === 'rad');
  const same = state.task === task.name;
  const data = same ? state.data : task.data[0].name;
  const by = key === 'nees' ? 'nees' : turned ? component : 'error';
  const shown = {
    component: turned ? component : task.map.x,
    track: key === 'nees' ? 'nees' : 'error',
  };
  return {
    task: task.name,
    filter,
    data,
    faults: blackout ? `blackout=${blackout}` : '',
    against: '',
    tab: 'failures',
    list: 'events',
    among: 'held-out',
    by,
    phase: '',
    ...shown,
  };
}

const black = (blackout) => `${percent(blackout)} black`;

/** Which training the bars are of, and what a click opens. */
function about({ study, found, quantity }, rows) {
  const open = [...new Set(rows.filter(({ here }) => here).map(({ here }) => here.seed))].sort();
  const none = rows.filter(({ here }) => !here).map(({ name }) => name);
  const opened = open.length
    ? `A click opens seed ${open.join(' or ')}, on this page’s held-out episodes instead`
    : 'None of its weights are here, so nothing can be opened';
  const but = open.length && none.length ? `; the weights of ${none.join(', ')} are not here` : '';
  return `${quantity.long}: ${study.seeds} seed${study.seeds > 1 ? 's' : ''} a filter, trained on ${found.data || 'data unknown'} (preset ${study.preset}) and measured on its test episodes. ${opened}${but}.`;
}

function heading({ by, title, help, bar, shown }, sort) {
  const cell = Object.assign(document.createElement('th'), {
    scope: 'col',
    className: bar === undefined && !shown ? '' : 'number',
  });
  const sorted = sort.by === by;
  cell.ariaSort = sorted ? (sort.down ? 'descending' : 'ascending') : 'none';
  const button = Object.assign(document.createElement('button'), {
    type: 'button',
    className: 'quiet sort',
    title: `${help}. Sort by it`,
    textContent: title,
  });
  button.dataset.column = by;
  cell.append(button);
  return cell;
}

function line(columns, row) {
  const made = document.createElement('tr');
  made.dataset.filter = row.name;
  const name = Object.assign(document.createElement('th'), { scope: 'row' });
  name.append(legendSample(row.name), row.name);
  made.append(name);
  for (const { bar, shown, value } of columns.slice(1)) {
    const cell = made.insertCell();
    cell.className = 'number';
    if (bar === undefined) cell.textContent = shown(value(row), row);
    else cell.append(linked(row.bars[bar]));
  }
  return made;
}

/** A bar's number. */
function linked(bar) {
  const text = bar.mean === null ? '–' : fixed(bar.mean, 2);
  const made = document.createElement(bar.href ? 'a' : 'span');
  [made.bar, made.textContent] = [bar, text];
  if (bar.href) [made.href, made.title] = [bar.href, `${bar.label}.`];
  if (bar.spread !== null)
    made.append(
      Object.assign(document.createElement('small'), { textContent: ` ± ${fixed(bar.spread, 2)}` }),
    );
  return made;
}

/** The predictor that always says the mean of the training states. */
function training({ rows }, { key }, columns) {
  const mean = rows.find(({ blackout }) => blackout === null)?.mean[key];
  if (typeof mean !== 'number') return [];
  const made = document.createElement('tr');
  made.append(
    Object.assign(document.createElement('th'), { scope: 'row', textContent: 'training mean' }),
  );
  columns.slice(1).forEach(({ bar }) => {
    const cell = made.insertCell();
    cell.className = 'number';
    if (bar !== undefined) cell.textContent = significant(mean);
  });
  return [made];
}
