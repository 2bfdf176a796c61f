/** Rows of the Experiments tab: quantities, values of their columns, and the order as text. */

/** @import { ExperimentRow } from '../types/server.js' */
/** @import { Sort } from '../widgets/sorting.js' */

import { displayName, fixed, percent } from '../core/units.js';
import { numberIn, provenanceOf } from './experiment_provenance.js';

/** @typedef {{title: string, help: string, hasUnit: boolean, format: (value: number | null) => string}} NumberColumn */

/** Numbers of all rows. @satisfies {Record<string, NumberColumn>} */
const NUMBERS = {
  error: {
    title: 'RMSE',
    help: 'Root mean square error of the position, or of the first map component, pooled over the steps',
    hasUnit: true,
    format: (value) => fixed(value, 2),
  },
  nees: {
    title: 'NEES/n',
    help: 'Mean normalised estimation error squared per component: 1 if the covariance is consistent',
    hasUnit: false,
    format: (value) => fixed(value, 2),
  },
  nll: {
    title: 'NLL',
    help: 'Mean negative log-likelihood of the true state (nats; m, rad)',
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
    help: 'Largest error of the position, or of the first map component, of all steps',
    hasUnit: true,
    format: (value) => fixed(value, 2),
  },
  episodes: { title: 'episodes', help: 'Number of episodes', hasUnit: false, format: String },
  steps: { title: 'steps', help: 'Number of steps', hasUnit: false, format: String },
};

const UNIT = /_(deg|cm|m)(\/s²?)?$/; // at the end of the key of a component

/**
 * Numbers of some rows by key: `NUMBERS`, with the RMSE of each component of the state after `error`.
 * @param {ExperimentRow[]} rows
 * @returns {Record<string, NumberColumn>}
 */
export function numbersOf(rows) {
  const { error, ...others } = NUMBERS;
  const keys = [...new Set(rows.flatMap(({ components }) => Object.keys(components)))];
  return {
    error,
    ...Object.fromEntries(keys.map((key) => [key, componentColumn(key)])),
    ...others,
  };
}

/** @param {string} key such as angle_deg @returns {NumberColumn} */
function componentColumn(key) {
  const [ending = '', unit = '', rate = ''] = key.match(UNIT) ?? [];
  const name = displayName(key.slice(0, key.length - ending.length));
  return {
    title: unit ? `${name}, ${unit === 'deg' ? '°' : unit}${rate}` : name,
    help: `Root mean square error of ${name}, pooled over the steps`,
    hasUnit: false,
    format: (value) => fixed(value, 2),
  };
}

/**
 * Value of a column: of the row itself, of its components or of its provenance.
 * @param {ExperimentRow} row
 * @param {string} column
 */
export function valueOf(row, column) {
  const value =
    column in row
      ? row[/** @type {keyof ExperimentRow} */ (column)]
      : (row.components[column] ?? provenanceOf(row)[column]);
  return typeof value === 'boolean' ? String(value) : (value ?? null);
}

/** Sensor faults as displayed. @param {string} faults empty for clean data */
export const faultsText = (faults) => faults || 'none';

/**
 * Value of a column with numbers; null for other values.
 * @param {ExperimentRow} row
 * @param {string} column
 */
export const numberOf = (row, column) => numberIn(valueOf(row, column));

/**
 * Value by which rows are sorted.
 * @param {ExperimentRow} row
 * @param {string} column
 * @param {boolean} hasNumbers whether the column has numbers only
 */
export function sortValue(row, column, hasNumbers) {
  const value = valueOf(row, column);
  if (hasNumbers) return numberIn(value);
  return value === null ? null : String(value);
}

/**
 * Identifies a row of a sweep.
 * @param {Pick<ExperimentRow, 'checkpoint' | 'data' | 'faults'>} row
 */
export const rowKey = ({ checkpoint, data, faults }) =>
  `${checkpoint.slice(0, 12)}.${data.slice(0, 12)}.${faults}`;

/**
 * Returns why a row cannot be compared with the displayed run; empty if it can.
 * @param {ExperimentRow} row
 * @param {string} task of the displayed run
 */
export const whyNotCompared = (row, task) =>
  row.task === task
    ? ''
    : `The displayed run is of task ${displayName(task)}: open an episode of this checkpoint first.`;

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

const LISTED = 8; // names in a message

/**
 * Reports a choice that does not exist; empty for an available one.
 * @param {string} kind such as Sweep
 * @param {string} name
 * @param {string[]} available
 * @param {string} effect what the page displays instead
 */
export function unknownChoice(kind, name, available, effect) {
  if (available.includes(name)) return '';
  const names = [...new Set(available)].filter(Boolean);
  const more = names.length > LISTED ? ` and ${names.length - LISTED} more` : '';
  return `${kind} “${name}” does not exist here: ${effect}. Available: ${names.slice(0, LISTED).join(', ')}${more}.`;
}

/**
 * Reads an order from the permalink: a column, with a minus for descending.
 * @param {string} text
 * @returns {Sort}
 */
export const parseSort = (text) => ({ name: text.replace(/^-/, ''), down: text.startsWith('-') });

/** @param {Sort} sort */
export const sortText = ({ name, down }) => `${down ? '-' : ''}${name}`;
