/** Table of the episodes of a data set, with the errors of the filter once it has run over them. */

/** @import { Store } from '../core/state.js' */
/** @import { DataSet, EpisodeErrors, EpisodeSummary, FailureScore, Failures, Task } from '../types/server.js' */
/** @import { Sort } from '../widgets/sorting.js' */

import { create, createButton, element, focusedIn, html } from '../core/dom.js';
import { isComplete } from '../core/episodes.js';
import { fixed, mainText, mainUnit, percent, withUnit } from '../core/units.js';
import { episodes } from '../data/api.js';
import { navigateRows, setTabStop } from '../widgets/row_navigation.js';
import { sortHeading, sortRows } from '../widgets/sorting.js';
import { markRow } from './event_table.js';
import { sparkline, sparklineScale } from './sparkline.js';

const PAGE = 200; // rows that are added at a time

/**
 * @typedef {object} EpisodeRow
 * @property {EpisodeSummary} summary
 * @property {EpisodeErrors | undefined} errors
 * @property {number | null} failures
 */
/**
 * @typedef {object} EpisodeColumn
 * @property {string} name
 * @property {string} title
 * @property {string} help
 * @property {boolean} number
 * @property {boolean} [isResult] whether the values depend on the filter
 * @property {(row: EpisodeRow) => number | string | null} value sort key; null if there is none
 * @property {(row: EpisodeRow) => string} content
 */

/**
 * @param {Task} task
 * @returns {EpisodeColumn[]}
 */
const columnsOf = (task) => [
  {
    ...summaryColumn('index', 'Index in the data set', ({ index }) => index),
    title: 'episode',
  },
  summaryColumn('split', 'Training, validation or test', ({ split }) => split),
  summaryColumn('policy', 'Policy of the robot', ({ policy }) => policy),
  summaryColumn('seed', 'Seed of the simulation', ({ seed }) => seed),
  summaryColumn('steps', 'Number of steps', ({ steps }) => steps),
  {
    ...summaryColumn('contact', 'Share of steps in contact', (s) => s.contact_fraction ?? ''),
    content: ({ summary }) => percent(summary.contact_fraction),
  },
  {
    ...errorColumn(
      task,
      'rmse',
      'RMSE without the warm-up of the task: 30 steps by default, none for field tasks',
      (e) => e?.rmse,
    ),
    title: withUnit('RMSE', mainUnit(task).unit),
  },
  {
    ...errorColumn(task, 'worst', 'Largest error', (e) => e?.worst),
    title: withUnit('worst', mainUnit(task).unit),
  },
  {
    name: 'failures',
    title: 'failures',
    help: 'Number of events by the selected score',
    number: true,
    isResult: true,
    value: ({ failures }) => failures,
    content: ({ failures }) => fixed(failures, 0),
  },
];

/**
 * @param {string} name
 * @param {string} help
 * @param {(summary: EpisodeSummary) => number | string | undefined} read
 * @returns {EpisodeColumn}
 */
function summaryColumn(name, help, read) {
  return {
    name,
    title: name,
    help,
    number: !['split', 'policy'].includes(name),
    value: ({ summary }) => read(summary) ?? '',
    content: ({ summary }) => String(read(summary) ?? ''),
  };
}

/**
 * @param {Task} task
 * @param {string} name
 * @param {string} help of the main error
 * @param {(errors: EpisodeErrors | undefined) => number | null | undefined} read
 * @returns {EpisodeColumn}
 */
function errorColumn(task, name, help, read) {
  return {
    name,
    title: name,
    help: `${help}: ${task.main.name}`,
    number: true,
    isResult: true,
    value: ({ errors }) => read(errors) ?? null,
    content: ({ errors }) => {
      const value = read(errors);
      return fixed(value === null ? null : Number(value) * mainUnit(task).scale, 2);
    },
  };
}

export class Episodes {
  #table;
  #head;
  #body;
  #store;
  /** Selected order; null for the default one. @type {Sort | null} */
  #selectedSort = null;
  /** @type {Failures | null} */
  #results = null;
  /** @type {FailureScore | null} */
  #score = null;
  /** Rows and their buttons by episode index. @type {Map<number, {row: HTMLTableRowElement, button: HTMLButtonElement}>} */
  #rows = new Map();
  #key = ''; // of the displayed table
  #limit = PAGE; // rows
  /** All episodes of data sets that the catalog lists in part. @type {Map<DataSet, EpisodeSummary[]>} */
  #listed = new Map();

  /**
   * @param {HTMLTableElement} table
   * @param {Store} store
   */
  constructor(table, store) {
    this.#table = table;
    this.#store = store;
    this.#head = element('thead', HTMLTableSectionElement, table);
    this.#body = element('tbody', HTMLTableSectionElement, table);
    navigateRows(this.#body);
    store.when(['episode'], () => this.#markEpisode());
  }

  /**
   * @param {Failures | null} results null if the filter has not run over the episodes
   * @param {FailureScore | null} score whose events are counted
   */
  show(results, score) {
    this.#results = results;
    this.#score = score;
    if (!this.#table.hidden) this.#draw();
  }

  /** @returns {Sort} */
  get #sort() {
    const standard = this.#results ? { name: 'worst', down: true } : { name: 'index', down: false };
    return this.#selectedSort ?? standard;
  }

  /** Sorted rows. */
  get #episodes() {
    const { data } = this.#store.state;
    const selected = this.#store.task();
    const sets = selected?.data ?? [];
    const set = sets.find(({ name }) => name === data);
    const summaries = (set && this.#listed.get(set)) ?? set?.episodes ?? [];
    const byIndex = new Map(this.#results?.episodes.map((errors) => [errors.index, errors]));
    const rows = summaries.map((summary) => {
      const errors = byIndex.get(summary.index);
      const failures = errors && this.#score ? (this.#score.counts?.[summary.index] ?? 0) : null;
      return { summary, errors, failures };
    });
    const { name: key, down } = this.#sort;
    const columns = selected ? columnsOf(selected) : [];
    const column = columns.find(({ name }) => name === key) ?? columns[0];
    return column ? sortRows(rows, column.value, down) : [];
  }

  #draw() {
    const { task, data, filter, faults, among, episode } = this.#store.state;
    const selected = this.#store.task();
    if (!selected) return;
    this.#list(selected.data.find(({ name }) => name === data));
    const run = [task, data, filter, faults, among, this.#score?.name, Boolean(this.#results)];
    const key = JSON.stringify([...run, this.#sort, this.#listed.size, this.#limit]);
    if (key === this.#key) return;
    this.#key = key;
    const focused = focusedIn(this.#head)?.dataset.part;
    const sorted = this.#episodes;
    const scale = sparklineScale(sorted.flatMap(({ errors }) => errors?.worst || []));
    const columns = columnsOf(selected).filter(
      ({ isResult, value }) => isResult || sorted.some((row) => value(row) !== ''),
    );
    const headings = columns.map((column) =>
      sortHeading(column, this.#sort, (sort) => this.#sortBy(sort), column.isResult),
    );
    this.#head.replaceChildren(create('tr', {}, ...headings, sparklineHeading(selected, scale)));
    this.#rows = new Map(
      sorted
        .slice(0, this.#limit)
        .map((row, i) => [row.summary.index, this.#row(selected, columns, row, scale, i)]),
    );
    this.#body.replaceChildren(...[...this.#rows.values()].map(({ row }) => row));
    if (sorted.length > this.#limit) this.#body.append(this.#more(sorted.length, columns));
    if (focused) html(`[data-part="${focused}"]`, this.#head).focus();
    this.#markEpisode();
    if (this.#table.parentElement) this.#table.parentElement.scrollTop = 0;
    // The default order begins at the selected episode, any other one at its first row.
    const current = this.#rows.get(episode);
    if (current && this.#sort.name === 'index' && !this.#selectedSort)
      setTabStop(current.row, false);
  }

  /**
   * Requests all episodes of a data set that the catalog lists in part.
   * @param {DataSet} [set]
   */
  async #list(set) {
    if (!set || isComplete(set) || this.#listed.has(set)) return;
    this.#listed.set(set, set.episodes);
    const all = await episodes(this.#store.state.task, set.name, { limit: set.count });
    this.#listed.set(set, all.episodes);
    this.#key = '';
    if (!this.#table.hidden) this.#draw();
  }

  /**
   * Returns the row that shows more rows.
   * @param {number} count of all rows
   * @param {EpisodeColumn[]} columns
   */
  #more(count, columns) {
    const text = `Show ${Math.min(PAGE, count - this.#limit)} more of ${count} episodes`;
    const button = createButton('text', text, () => {
      const scrolled = this.#table.parentElement;
      const top = scrolled?.scrollTop ?? 0;
      this.#limit += PAGE;
      this.#draw();
      scrolled?.scrollTo({ top });
    });
    return create('tr', {}, create('td', { colSpan: columns.length + 1 }, button));
  }

  /** @param {Sort} sort */
  #sortBy(sort) {
    this.#selectedSort = sort;
    this.#draw();
  }

  /**
   * @param {Task} task
   * @param {EpisodeColumn[]} columns
   * @param {EpisodeRow} episode
   * @param {number} scale of the sparklines
   * @param {number} i place in the table
   */
  #row(task, columns, episode, scale, i) {
    const { index } = episode.summary;
    const row = document.createElement('tr');
    const properties = { ariaLabel: `Episode ${index}`, tabIndex: i ? -1 : 0 };
    const button = createButton('title', String(index), () => this.#open(index, 0), properties);
    for (const { name, number, content } of columns) {
      const cell = row.insertCell();
      cell.className = number ? 'number' : '';
      cell.append(name === 'index' ? button : content(episode));
    }
    const cell = row.insertCell();
    cell.className = 'spark';
    if (episode.errors && scale)
      cell.append(
        sparkline(task, episode.errors, scale, (step, time) => this.#open(index, step, time)),
      );
    return { row, button };
  }

  /**
   * @param {number} episode
   * @param {number} step
   * @param {number | null} [inputTime]
   */
  #open(episode, step, inputTime = null) {
    this.#store.set({ episode, step, playing: false }, { inputTime });
  }

  /** Highlights the row of the selected episode. */
  #markEpisode() {
    const { episode } = this.#store.state;
    for (const [index, { row, button }] of this.#rows) markRow(row, button, index === episode);
  }
}

/**
 * @param {Task} task
 * @param {number} scale
 */
const sparklineHeading = (task, scale) =>
  create('th', {
    scope: 'col',
    textContent: scale ? `error over time, 0–${mainText(task, scale)}` : 'error over time',
    title:
      'Main error; steps in contact are shaded. Same scale for all episodes; larger errors are cut off. Click a step to go there',
  });
