/** Columns of channels, with names and units: readings of sensors, residuals, controls, and innovations. */

/** @import { Column, Series } from './arrays.js' */

import { displayUnit } from '../core/units.js';
import { slice } from './arrays.js';

/** Start of the names of columns with the readings of a vector sensor, or with the controls. */
export const READINGS = 'readings/';
/** Start of the names of columns with the readings of a vector sensor minus the true state. */
export const RESIDUAL = 'residual/';
/** Start of the names of columns with the innovation of a modality, in the space of its measurements. */
export const INNOVATION = 'innovation/';
/** Start of the names of columns with its predicted standard deviation. */
const INNOVATION_SIGMA = 'innovation_sigma/';

/**
 * @typedef {object} Channel
 * @property {string} name such as force x
 * @property {string} unit for display
 * @property {Series} values in that unit
 * @property {Series} [sigma] predicted standard deviation
 */

export class Channels {
  #columns;
  /** @type {Map<string, Channel[]>} */
  #cache = new Map();

  /** @param {Map<string, Column>} columns of a trace, which may get more */
  constructor(columns) {
    this.#columns = columns;
  }

  /** Forgets values that are outdated since the columns have grown. */
  clear() {
    this.#cache.clear();
  }

  /**
   * Returns the names of the columns with a common start.
   * @param {string} start
   */
  columns(start) {
    return [...this.#columns.keys()].filter((name) => name.startsWith(start));
  }

  /**
   * Returns the channels of a column of readings, residuals or innovations, in their units for display; none without it.
   * @param {string} column
   */
  of(column) {
    return this.#cached(column, () => decoded(this.#columns.get(column)));
  }

  /**
   * Returns the channels with values of an innovation that the filter reports, with their standard deviations, which
   * are held between measurements.
   * @param {string} column
   */
  innovation(column) {
    return this.#cached(`innovation ${column}`, () => {
      const sigmas = this.of(column.replace(INNOVATION, INNOVATION_SIGMA));
      return this.of(column).flatMap((channel, i) =>
        channel.values.some(Number.isFinite) ? [{ ...channel, sigma: held(sigmas[i].values) }] : [],
      );
    });
  }

  /**
   * @param {string} key
   * @param {() => Channel[]} compute
   */
  #cached(key, compute) {
    const channels = this.#cache.get(key) ?? compute();
    this.#cache.set(key, channels);
    return channels;
  }
}

/**
 * Returns the channels of a column in their units for display.
 * @param {Column | undefined} column none without a column
 * @returns {Channel[]}
 */
const decoded = (column) =>
  (column?.channels ?? []).map((channel, i) => {
    const { unit, scale } = displayUnit(channel);
    const values = slice(/** @type {Column} */ (column), [i]);
    return { name: channel.name, unit, values: values.map((value) => value * scale) };
  });

/**
 * Returns values with the last finite one in place of missing ones; NaN before the first one.
 * @param {Series} values
 */
function held(values) {
  let last = NaN;
  return values.map((value) => (last = Number.isFinite(value) ? value : last));
}
