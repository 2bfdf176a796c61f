/** Table of a study: one row per filter, with the selected quantity per share of image blackout. */

/** @import { StudyRow, TrainedSeed } from '../types/server.js' */
/** @import { Bar } from '../widgets/bar_chart.js' */
/** @import { Sort } from '../widgets/sorting.js' */
/** @import { Quantity } from './study_quantities.js' */

import { create, element, fillTable, html } from '../core/dom.js';
import { fixed, percent, significant } from '../core/units.js';
import { legendSample, navigateLinks } from '../widgets/bar_chart.js';
import { sortHeading, sortRows } from '../widgets/sorting.js';
import { blackoutLabel } from './study_quantities.js';

/**
 * Results of a filter.
 * @typedef {object} FilterResults
 * @property {string} name
 * @property {string} colour its property
 * @property {TrainedSeed | null} checkpoint opened by the links; null if no weights are available
 * @property {StudyRow[]} rows per share of image blackout
 * @property {Bar[]} bars of these rows
 */

/**
 * @typedef {object} StudyView
 * @property {string} task
 * @property {Quantity} quantity
 * @property {string} start offset of the first belief from the truth, or empty
 * @property {(number | null)[]} blackouts shares of image blackout
 * @property {FilterResults[]} filters
 * @property {{name: string, value: number} | null} level error of a predictor without observations
 */

/**
 * @typedef {object} StudyColumn
 * @property {string} name
 * @property {string} title
 * @property {string} help
 * @property {(filter: FilterResults) => number | null} value
 * @property {(filter: FilterResults) => string | Node} content
 */

/** Other errors without image blackout; missing in studies of earlier versions. */
const ERRORS = [
  {
    title: 'from step 0',
    help: 'On clean images, including the first 30 steps',
    values: (/** @type {StudyRow} */ row) => row.from_step_0,
  },
  {
    title: 'dynamics',
    help: 'Baseline: the same filter with all observations masked',
    values: (/** @type {StudyRow} */ row) => row.baselines.dynamics,
  },
  {
    title: 'stay',
    help: 'Baseline: the start as the estimate of all steps',
    values: (/** @type {StudyRow} */ row) => row.baselines.stay,
  },
];
/** Metrics without image blackout. */
const METRICS = [
  {
    key: 'nees',
    title: 'NEES/n',
    help: 'On clean images: 1 if the covariance is consistent',
    format: (/** @type {number | null} */ value) => fixed(value, 2),
  },
  {
    key: 'coverage95',
    title: '95 % coverage',
    help: 'On clean images: share of steps whose 95 % ellipsoid contains the true state',
    format: percent,
  },
  {
    key: 'seconds',
    title: 'training, s',
    help: 'Training time, mean over the seeds',
    format: (/** @type {number | null} */ value) => fixed(value, 0),
  },
];

export class StudyTable {
  #table;
  /** @type {StudyView | null} */
  #view = null;
  /** @type {Sort} */
  #sort = { name: 'filter', down: false };

  /**
   * @param {HTMLTableElement} table
   * @param {(filter: string) => void} onPoint called with the filter under the pointer or with the focus, or ''
   */
  constructor(table, onPoint) {
    this.#table = table;
    const body = element('tbody', HTMLTableSectionElement, table);
    navigateLinks(body);
    /** @param {Event} event */
    const point = ({ target }) => {
      const row = target instanceof Element ? target.closest('tr') : null;
      onPoint(row?.dataset.filter ?? '');
    };
    for (const kind of ['pointerover', 'focusin']) body.addEventListener(kind, point);
    for (const kind of ['pointerleave', 'focusout']) body.addEventListener(kind, () => onPoint(''));
  }

  /** @param {StudyView} view */
  show(view) {
    this.#view = view;
    const { quantity, task, filters, blackouts } = view;
    const columns = studyColumns(view);
    const isKnown = columns.some(({ name }) => name === this.#sort.name);
    const sort = isKnown ? this.#sort : { name: 'filter', down: false };
    const { value } = columns.find(({ name }) => name === sort.name) ?? columns[0];
    this.#table.ariaLabel = `${quantity.description} of ${task}: mean over the seeds ± standard deviation`;
    const headings = columns.map((column, i) =>
      sortHeading({ ...column, number: i > 0 }, sort, (order) => this.#sortBy(order)),
    );
    const rows = sortRows(filters, value, sort.down).map((filter) => tableRow(columns, filter));
    fillTable(this.#table, headings, [...rows, ...referenceRow(view, columns)]);
    const [body] = this.#table.tBodies;
    body.dataset.row = String(blackouts.length);
    body.querySelectorAll('a').forEach((link, i) => (link.tabIndex = i ? -1 : 0));
  }

  /**
   * Highlights the row of a filter; none for an empty name.
   * @param {string} filter
   */
  mark(filter) {
    const [body] = this.#table.tBodies;
    for (const row of body.rows)
      row.classList.toggle('here', Boolean(filter) && row.dataset.filter === filter);
  }

  /** @param {Sort} sort */
  #sortBy(sort) {
    this.#sort = sort;
    if (this.#view) this.show(this.#view);
    html(`[data-part="sort ${sort.name}"]`, this.#table).focus();
  }
}

/**
 * @param {StudyView} view
 * @returns {StudyColumn[]}
 */
function studyColumns({ quantity, blackouts, filters }) {
  const unit = quantity.unit && `, ${quantity.unit}`;
  const errors = ERRORS.map(({ title, help, values }) => ({
    name: title,
    title: title + unit,
    help,
    value: (/** @type {FilterResults} */ { rows }) => values(rows[0])?.[quantity.key] ?? null,
  })).filter(({ value }) => filters.some((filter) => value(filter) !== null));
  const metrics = METRICS.filter(({ key }) =>
    filters.some(({ rows }) => typeof rows[0].mean[key] === 'number'),
  );
  return [
    {
      name: 'filter',
      title: 'filter',
      help: 'Order of the study',
      value: (filter) => filters.indexOf(filter),
      content: ({ name }) => name,
    },
    ...blackouts.map((share, i) => ({
      name: `blackout ${i}`,
      title: blackoutLabel(share) + (i ? '' : unit),
      help: quantity.description,
      value: (/** @type {FilterResults} */ { bars }) => bars[i].mean,
      content: (/** @type {FilterResults} */ { bars }) => barValue(bars[i]),
    })),
    ...errors.map((column) => ({
      ...column,
      content: (/** @type {FilterResults} */ filter) => fixed(column.value(filter), 2),
    })),
    ...metrics.map(({ key, title, help, format }) => ({
      name: key,
      title,
      help,
      value: (/** @type {FilterResults} */ { rows }) => rows[0].mean[key] ?? null,
      content: (/** @type {FilterResults} */ { rows }) => format(rows[0].mean[key] ?? null),
    })),
    {
      name: 'seeds',
      title: 'seeds',
      help: 'Finished and requested seeds',
      value: ({ rows }) => rows[0].seeds,
      content: ({ rows: [{ seeds, requested, failed }] }) =>
        `${seeds} of ${requested}${failed ? `, ${failed} failed` : ''}`,
    },
  ];
}

/**
 * @param {StudyColumn[]} columns
 * @param {FilterResults} filter
 */
function tableRow(columns, filter) {
  const row = document.createElement('tr');
  row.dataset.filter = filter.name;
  row.append(create('th', { scope: 'row' }, legendSample(filter.name, filter.colour), filter.name));
  for (const { content } of columns.slice(1)) {
    const cell = row.insertCell();
    cell.className = 'number';
    cell.append(content(filter));
  }
  return row;
}

/**
 * Returns the value of a bar, as a link if there is something to open.
 * @param {Bar} bar
 */
function barValue({ mean, spread, href, label }) {
  const value = create('span', { textContent: fixed(mean, 2) });
  if (spread !== null) value.append(create('small', {}, ` ± ${fixed(spread, 2)}`));
  if (href === null) return value;
  const link = create('a', { href, title: `${label}.` }, ...value.childNodes);
  link.dataset.label = label;
  return link;
}

/**
 * Returns the row of the predictor without observations.
 * @param {StudyView} view
 * @param {StudyColumn[]} columns
 */
function referenceRow({ level, blackouts }, columns) {
  if (level === null) return [];
  const row = create('tr', {}, create('th', { scope: 'row', textContent: level.name }));
  columns.slice(1).forEach((_, i) => {
    const cell = row.insertCell();
    cell.className = 'number';
    if (i < blackouts.length) cell.textContent = significant(level.value);
  });
  return [row];
}
