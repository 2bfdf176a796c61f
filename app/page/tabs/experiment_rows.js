/** Rows of the Experiments tab: quantities, filtering by words and conditions, and the order as text. */

/** @import { ExperimentRow } from '../types/server.js' */
/** @import { Sort } from '../widgets/sorting.js' */

import { fixed, percent } from '../core/units.js';
import { provenanceOf } from './experiment_provenance.js';

/** @typedef {'error' | 'nees' | 'coverage95' | 'worst' | 'episodes' | 'steps'} NumberKey */
/** @typedef {{title: string, help: string, hasUnit: boolean, format: (value: number | null) => string}} NumberColumn */

/** Numbers of a row. @type {Record<NumberKey, NumberColumn>} */
export const NUMBERS = {
  error: {
    title: 'RMSE',
    help: 'Root mean square position error, pooled over the steps',
    hasUnit: true,
    format: (value) => fixed(value, 2),
  },
  nees: {
    title: 'NEES/n',
    help: 'Mean normalised squared error: 1 if the covariance is consistent',
    hasUnit: false,
    format: (value) => fixed(value, 2),
  },
  coverage95: {
    title: '95 % coverage',
    help: 'Share of steps whose 95 % ellipsoid contains the true state',
    hasUnit: false,
    format: percent,
  },
  worst: {
    title: 'worst',
    help: 'Largest position error of all steps',
    hasUnit: true,
    format: (value) => fixed(value, 2),
  },
  episodes: { title: 'episodes', help: 'Number of episodes', hasUnit: false, format: String },
  steps: { title: 'steps', help: 'Number of steps', hasUnit: false, format: String },
};

export const NUMBER_KEYS = /** @type {NumberKey[]} */ (Object.keys(NUMBERS));

/**
 * Value of a column, by which rows are sorted: of the row itself or of its provenance.
 * @param {ExperimentRow} row
 * @param {string} column
 */
export function valueOf(row, column) {
  const value =
    column in row ? row[/** @type {keyof ExperimentRow} */ (column)] : provenanceOf(row)[column];
  return typeof value === 'boolean' ? String(value) : (value ?? null);
}

/**
 * Value of a column with numbers; null for other values.
 * @param {ExperimentRow} row
 * @param {string} column
 */
export function numberOf(row, column) {
  const value = valueOf(row, column);
  return typeof value === 'number' ? value : null;
}

/**
 * Identifies a row of a sweep.
 * @param {Pick<ExperimentRow, 'checkpoint' | 'data' | 'faults'>} row
 */
export const rowKey = ({ checkpoint, data, faults }) =>
  `${checkpoint.slice(0, 12)}.${data.slice(0, 12)}.${faults}`;

/** @type {Record<string, (value: number, limit: number) => boolean>} */
const COMPARISONS = {
  '>': (value, limit) => value > limit,
  '<': (value, limit) => value < limit,
  '>=': (value, limit) => value >= limit,
  '<=': (value, limit) => value <= limit,
};

const CONDITION = /^([^<>=]+)(>=|<=|>|<)(-?[\d.]+(?:e-?\d+)?)$/i;

/**
 * Reports the conditions, such as `neez>2`, whose column does not exist; empty without any.
 * @param {string} text
 * @param {string[]} columns names of the columns with numbers
 */
export function unknownConditions(text, columns) {
  const unknown = text.split(/\s+/).filter((word) => {
    const [, key] = word.match(CONDITION) ?? [];
    return key !== undefined && !columns.includes(key);
  });
  return unknown.length
    ? `No column with numbers for ${unknown.join(', ')}. Columns: ${columns.join(', ')}.`
    : '';
}

/**
 * The comparison of the displayed run with a row: by filter or, if both have the same one, by sensor faults.
 * @param {Pick<ExperimentRow, 'faults'>} row
 * @param {string} filter of the row
 * @param {string} displayed filter
 */
export const comparedWith = ({ faults }, filter, displayed) =>
  filter === displayed
    ? `faults=${encodeURIComponent(faults)}`
    : `filter=${encodeURIComponent(filter)}`;

/**
 * Returns the rows that contain all words, in any text or the provenance, and meet all conditions such as `nees>2`.
 * @param {ExperimentRow[]} rows
 * @param {string} text
 */
export function matching(rows, text) {
  const tests = text
    .split(/\s+/)
    .filter(Boolean)
    .map((word) => {
      const [, key, sign, limit] = word.match(CONDITION) ?? [];
      if (rows.some((row) => numberOf(row, key) !== null))
        return (/** @type {ExperimentRow} */ row) => {
          const value = numberOf(row, key);
          return value !== null && COMPARISONS[sign](value, Number(limit));
        };
      const part = word.toLowerCase();
      return (/** @type {ExperimentRow} */ { name, filter, task, faults, provenance }) =>
        [name, filter, task, faults, provenance].some((t) => t.toLowerCase().includes(part));
    });
  return rows.filter((row) => tests.every((test) => test(row)));
}

/**
 * Reads an order from the permalink: a column, with a minus for descending.
 * @param {string} text
 * @returns {Sort}
 */
export const parseSort = (text) => ({ name: text.replace(/^-/, ''), down: text.startsWith('-') });

/** @param {Sort} sort */
export const sortText = ({ name, down }) => `${down ? '-' : ''}${name}`;
