/** Table of the episodes of a data set, with the errors of the filter once it has run over them. */

/** @import { Store } from '../core/state.js' */
/** @import { Catalog, EpisodeErrors, EpisodeSummary, FailureScore, Failures } from '../types/server.js' */
/** @import { Sort } from '../widgets/sorting.js' */

import { create, element, html } from '../core/dom.js';
import { fixed, percent } from '../core/units.js';
import { navigateRows, setTabStop } from '../widgets/row_navigation.js';
import { sortHeading, sortRows } from '../widgets/sorting.js';
import { centimetres, markRow } from './event_table.js';
import { sparkline, sparklineScale } from './sparkline.js';

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

/** @type {EpisodeColumn[]} */
const COLUMNS = [
  {
    ...summaryColumn('index', 'Index in the data set', ({ index }) => index),
    title: 'episode',
  },
  summaryColumn('split', 'Training, validation or test', ({ split }) => split),
  summaryColumn('policy', 'Policy of the robot', ({ policy }) => policy),
  summaryColumn('seed', 'Seed of the simulation', ({ seed }) => seed),
  summaryColumn('steps', 'Number of steps', ({ steps }) => steps),
  {
    ...summaryColumn('contact', 'Share of steps in contact', (s) => s.contact_fraction),
    content: ({ summary }) => percent(summary.contact_fraction),
  },
  {
    ...errorColumn(
      'rmse',
      'Position RMSE, without the first 30 steps (field tasks: all steps)',
      (e) => e?.rmse,
    ),
    title: 'RMSE cm',
  },
  {
    ...errorColumn('worst', 'Largest position error', (e) => e?.worst),
    title: 'worst cm',
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
 * @param {string} name
 * @param {string} help
 * @param {(errors: EpisodeErrors | undefined) => number | null | undefined} read m
 * @returns {EpisodeColumn}
 */
function errorColumn(name, help, read) {
  return {
    name,
    title: name,
    help,
    number: true,
    isResult: true,
    value: ({ errors }) => read(errors) ?? null,
    content: ({ errors }) => centimetres(read(errors)),
  };
}

export class Episodes {
  #table;
  #head;
  #body;
  #store;
  #catalog;
  /** Selected order; null for the default one. @type {Sort | null} */
  #selectedSort = null;
  /** @type {Failures | null} */
  #results = null;
  /** @type {FailureScore | null} */
  #score = null;
  /** Rows and their buttons by episode index. @type {Map<number, {row: HTMLTableRowElement, button: HTMLButtonElement}>} */
  #rows = new Map();
  #key = ''; // of the displayed table

  /**
   * @param {HTMLTableElement} table
   * @param {Store} store
   * @param {Catalog} catalog
   */
  constructor(table, store, catalog) {
    this.#table = table;
    this.#store = store;
    this.#catalog = catalog;
    this.#head = element('thead', HTMLTableSectionElement, table);
    this.#body = element('tbody', HTMLTableSectionElement, table);
    navigateRows(this.#body);
    store.listen((_, changed) => changed.has('episode') && this.#markEpisode());
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
    const { task, data } = this.#store.state;
    const sets = this.#catalog.tasks.find(({ name }) => name === task)?.data ?? [];
    const summaries = sets.find(({ name }) => name === data)?.episodes ?? [];
    const byIndex = new Map(this.#results?.episodes.map((errors) => [errors.index, errors]));
    const episodes = summaries.map((summary) => {
      const errors = byIndex.get(summary.index);
      const failures = errors && this.#score ? (this.#score.counts?.[summary.index] ?? 0) : null;
      return { summary, errors, failures };
    });
    const { name: key, down } = this.#sort;
    const column = COLUMNS.find(({ name }) => name === key) ?? COLUMNS[0];
    return sortRows(episodes, column.value, down);
  }

  #draw() {
    const { task, data, filter, faults, among, episode } = this.#store.state;
    const run = [task, data, filter, faults, among];
    const key = JSON.stringify([...run, this.#score?.name, Boolean(this.#results), this.#sort]);
    if (key === this.#key) return;
    this.#key = key;
    const { activeElement } = document;
    const focused =
      activeElement instanceof HTMLElement && this.#table.contains(activeElement)
        ? activeElement.dataset.column
        : undefined;
    const episodes = this.#episodes;
    const scale = sparklineScale(episodes.flatMap(({ errors }) => errors?.worst || []));
    const columns = COLUMNS.filter(
      ({ isResult, value }) => isResult || episodes.some((row) => value(row) !== ''),
    );
    const headings = columns.map((column) =>
      sortHeading(column, this.#sort, (sort) => this.#sortBy(sort), column.isResult),
    );
    this.#head.replaceChildren(create('tr', {}, ...headings, sparklineHeading(scale)));
    this.#rows = new Map(
      episodes.map((row, i) => [row.summary.index, this.#row(columns, row, scale, i)]),
    );
    this.#body.replaceChildren(...[...this.#rows.values()].map(({ row }) => row));
    if (focused) html(`[data-column="${focused}"]`, this.#head).focus();
    this.#markEpisode();
    if (this.#table.parentElement) this.#table.parentElement.scrollTop = 0;
    // The default order begins at the selected episode, any other one at its first row.
    const current = this.#rows.get(episode);
    if (current && this.#sort.name === 'index' && !this.#selectedSort)
      setTabStop(current.row, false);
  }

  /** @param {Sort} sort */
  #sortBy(sort) {
    this.#selectedSort = sort;
    this.#draw();
  }

  /**
   * @param {EpisodeColumn[]} columns
   * @param {EpisodeRow} episode
   * @param {number} scale of the sparklines, m
   * @param {number} i place in the table
   */
  #row(columns, episode, scale, i) {
    const { index } = episode.summary;
    const row = document.createElement('tr');
    const button = create('button', {
      type: 'button',
      className: 'title',
      textContent: String(index),
      ariaLabel: `Episode ${index}`,
      tabIndex: i ? -1 : 0,
    });
    button.addEventListener('click', () => this.#open(index, 0));
    for (const { name, number, content } of columns) {
      const cell = row.insertCell();
      cell.className = number ? 'number' : '';
      cell.append(name === 'index' ? button : content(episode));
    }
    const cell = row.insertCell();
    cell.className = 'spark';
    if (episode.errors && scale)
      cell.append(sparkline(episode.errors, scale, (step, time) => this.#open(index, step, time)));
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

/** @param {number} scale m */
const sparklineHeading = (scale) =>
  create('th', {
    scope: 'col',
    textContent: scale ? `error over time, 0–${fixed(100 * scale, 1)} cm` : 'error over time',
    title:
      'Position error; steps in contact are shaded. Same scale for all episodes; larger errors are cut off. Click a step to go there',
  });
