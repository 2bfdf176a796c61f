/** The episodes of the data set as a table that can be sorted: what each is, and how the filter did on it where that is known. */

import { setTabStop, navigateRows } from '../widgets/row_navigation.js';
import { fixed, percent } from '../core/units.js';

const HEIGHT = 20; // of a sparkline, in its own units
const SEEN = 0.95; // share of the episodes whose sparklines are not cut off

/**
 * @typedef {{summary: import('../data/api.js').Summary, errors: object | undefined, failures: number | undefined}} Line
 * @typedef {object} Column
 * @property {string} name @property {string} title @property {string} help
 * @property {(line: Line) => number | string | null} value by which it is sorted; null where it is not known
 * @property {(line: Line) => string | Node} shown @property {boolean} [words]
 * @property {boolean} [surveyed] only known once the filter ran over it
 */

/** @type {Column[]} */
const COLUMNS = [
  {
    name: 'index',
    title: 'episode',
    help: 'Its index in the data set',
    value: ({ summary }) => summary.index,
    shown: ({ summary }) => String(summary.index),
  },
  {
    name: 'split',
    title: 'split',
    help: 'What it is kept for',
    value: ({ summary }) => summary.split,
    shown: ({ summary }) => summary.split,
    words: true,
  },
  {
    name: 'policy',
    title: 'policy',
    help: 'How the robot moved',
    value: ({ summary }) => summary.policy,
    shown: ({ summary }) => summary.policy,
    words: true,
  },
  {
    name: 'seed',
    title: 'seed',
    help: 'That it was simulated with',
    value: ({ summary }) => summary.seed,
    shown: ({ summary }) => String(summary.seed),
  },
  {
    name: 'steps',
    title: 'steps',
    help: 'How long it is',
    value: ({ summary }) => summary.steps,
    shown: ({ summary }) => String(summary.steps),
  },
  {
    name: 'contact',
    title: 'contact',
    help: 'Share of its steps in contact',
    value: ({ summary }) => summary.contact_fraction,
    shown: ({ summary }) => percent(summary.contact_fraction),
  },
  {
    name: 'rmse',
    title: 'RMSE cm',
    help: 'Of the position, without the first 30 steps',
    value: ({ errors }) => errors?.rmse ?? null,
    shown: ({ errors }) => centimetres(errors?.rmse),
    surveyed: true,
  },
  {
    name: 'worst',
    title: 'worst cm',
    help: 'Largest error of the position',
    value: ({ errors }) => errors?.worst ?? null,
    shown: ({ errors }) => centimetres(errors?.worst),
    surveyed: true,
  },
  {
    name: 'failures',
    title: 'failures',
    help: 'Moments by the chosen measure',
    value: ({ failures }) => failures ?? null,
    shown: ({ failures }) => fixed(failures, 0),
    surveyed: true,
  },
];

/** m at which the sparklines end: the few episodes that are worse by far are cut off, so that the others can be seen. */
function scale(lines) {
  const worst = lines
    .map(({ errors }) => errors?.worst ?? 0)
    .filter(Boolean)
    .sort((a, b) => a - b);
  return worst[Math.ceil(SEEN * (worst.length - 1))] ?? 0;
}

const centimetres = (metres) =>
  fixed(metres === undefined || metres === null ? null : 100 * metres, 2);

export class Episodes {
  #host;
  #store;
  #catalog;
  #chosen = null; // how they are sorted, once somebody said so
  #found = null;
  #score = null;
  #rows = new Map(); // by index
  #shown = '';

  /** @param {HTMLElement} host @param {import('../core/state.js').Store} store @param {import('../data/api.js').Catalog} catalog */
  constructor(host, store, catalog) {
    [this.#host, this.#store, this.#catalog] = [host, store, catalog];
    navigateRows(host.querySelector('tbody'));
    store.listen((_, changed) => changed.has('episode') && this.#here());
  }

  /** @param {import('../data/api.js').Failures | null} found null where nobody has looked @param {object | null} score whose moments are counted */
  show(found, score) {
    [this.#found, this.#score] = [found, score];
    if (!this.#host.hidden) this.#draw();
  }

  /** The worst first where that is known. */
  get #sort() {
    return (
      this.#chosen ?? (this.#found ? { name: 'worst', down: true } : { name: 'index', down: false })
    );
  }

  get #lines() {
    const { task, data } = this.#store.state;
    const { episodes } = this.#catalog.tasks
      .find((t) => t.name === task)
      .data.find((d) => d.name === data);
    const errors = new Map((this.#found?.episodes ?? []).map((one) => [one.index, one]));
    const lines = episodes.map((summary) => {
      const known = errors.get(summary.index);
      return {
        summary,
        errors: known,
        failures: known && this.#score ? (this.#score.counts[summary.index] ?? 0) : undefined,
      };
    });
    const { name: by, down } = this.#sort;
    const { value } = COLUMNS.find(({ name }) => name === by);
    const sign = down ? -1 : 1;
    const order = (a, b) => (typeof a === 'string' ? a.localeCompare(b) : a - b);
    const known = lines
      .filter((line) => value(line) !== null)
      .sort((a, b) => sign * order(value(a), value(b)));
    return [...known, ...lines.filter((line) => value(line) === null)];
  }

  #draw() {
    const { task, data, filter, faults, among } = this.#store.state;
    const shown = JSON.stringify([
      task,
      data,
      filter,
      faults,
      among,
      this.#score?.name,
      Boolean(this.#found),
      this.#sort,
    ]);
    if (shown === this.#shown) return;
    this.#shown = shown;
    const focused = this.#host.contains(document.activeElement)
      ? document.activeElement.dataset.column
      : undefined;
    const lines = this.#lines;
    const most = scale(lines);
    const columns = COLUMNS.filter(
      ({ surveyed, value }) => surveyed || lines.some((line) => value(line) !== ''),
    );
    const top = document.createElement('tr');
    top.append(...columns.map((column) => this.#heading(column)), this.#scale(most));
    this.#host.querySelector('thead').replaceChildren(top);
    this.#rows = new Map(
      lines.map((line, i) => [line.summary.index, this.#row(columns, line, most, i)]),
    );
    this.#host
      .querySelector('tbody')
      .replaceChildren(...[...this.#rows.values()].map(({ row }) => row));
    if (focused) top.querySelector(`[data-column="${focused}"]`)?.focus();
    this.#here();
    this.#host.parentElement.scrollTop = 0;
    // A list by index begins where one is; any other with its first.
    const open = this.#rows.get(this.#store.state.episode);
    if (open && this.#sort.name === 'index' && !this.#chosen) setTabStop(open.row, false);
  }

  #heading({ name, title, help, words, surveyed }) {
    const cell = Object.assign(document.createElement('th'), {
      scope: 'col',
      className: words ? '' : 'number',
    });
    const sorted = this.#sort.name === name;
    cell.ariaSort = sorted ? (this.#sort.down ? 'descending' : 'ascending') : 'none';
    const button = Object.assign(document.createElement('button'), {
      type: 'button',
      className: 'quiet sort',
      title: `${help}. Sort by it`,
      textContent: title,
    });
    button.dataset.column = name;
    button.addEventListener('click', () => {
      // What tells bad episodes from good ones begins with the bad ones.
      this.#chosen = { name, down: sorted ? !this.#sort.down : Boolean(surveyed) };
      this.#draw();
    });
    cell.append(button);
    return cell;
  }

  #scale(most) {
    const text = most ? `error over time, 0–${fixed(100 * most, 1)} cm` : 'error over time';
    return Object.assign(document.createElement('th'), {
      scope: 'col',
      textContent: text,
      title:
        'Of the position, contact behind it; one scale for all, cut off above it. A click goes to that step',
    });
  }

  #row(columns, line, most, i) {
    const { index } = line.summary;
    const row = document.createElement('tr');
    const go = Object.assign(document.createElement('button'), {
      type: 'button',
      className: 'title',
      textContent: String(index),
    });
    go.setAttribute('aria-label', `Episode ${index}`);
    go.tabIndex = i ? -1 : 0;
    go.addEventListener('click', () =>
      this.#store.set({ episode: index, step: 0, playing: false }),
    );
    for (const column of columns) {
      const cell = row.insertCell();
      cell.className = column.words ? '' : 'number';
      cell.append(column.name === 'index' ? go : column.shown(line));
    }
    const cell = row.insertCell();
    cell.className = 'spark';
    if (line.errors && most) cell.append(this.#spark(line.errors, most));
    return { row, button: go };
  }

  /** The error over the episode, and a click that goes there. */
  #spark({ index, steps, error, contact, worst, worst_step: at }, most) {
    const svg = document.createElementNS('http://www.w3.org/2000/svg', 'svg');
    const parts = error.length;
    svg.setAttribute('viewBox', `0 0 ${parts} ${HEIGHT}`);
    svg.setAttribute('preserveAspectRatio', 'none');
    svg.setAttribute('role', 'img');
    svg.setAttribute(
      'aria-label',
      `Error over time, at most ${centimetres(worst)} cm, at step ${at}`,
    );
    const touched = contact.map((on, i) => (on ? `M${i} 0h1v${HEIGHT}h-1z` : '')).join('');
    const y = (value) => (HEIGHT - 1 - (HEIGHT - 2) * Math.min(1, value / most)).toFixed(2);
    const line = error
      .map((value, i) =>
        value === null ? '' : `${i && error[i - 1] !== null ? 'L' : 'M'}${i + 0.5} ${y(value)}`,
      )
      .join('');
    for (const [kind, d] of [
      ['contact', touched],
      ['error', line],
    ]) {
      const path = document.createElementNS(svg.namespaceURI, 'path');
      path.setAttribute('class', kind);
      path.setAttribute('d', d || 'M0 0');
      svg.append(path);
    }
    const title = document.createElementNS(svg.namespaceURI, 'title');
    title.textContent = `At most ${centimetres(worst)} cm, at step ${at}`;
    svg.append(title);
    svg.addEventListener('click', (event) => {
      const { left, width } = svg.getBoundingClientRect();
      const step = Math.min(Math.floor((steps * (event.clientX - left)) / width), steps - 1);
      this.#store.set(
        { episode: index, step: Math.max(step, 0), playing: false },
        { inputTime: event.timeStamp },
      );
    });
    return svg;
  }

  /** Which row is of the episode that is shown. */
  #here() {
    for (const [index, { row, button }] of this.#rows) {
      const here = index === this.#store.state.episode;
      row.classList.toggle('here', here);
      if (here) button.setAttribute('aria-current', 'true');
      else button.removeAttribute('aria-current');
    }
  }
}
