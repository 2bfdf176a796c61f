/** The charts of the timeline and their order, as text: weights,estimate,track. */

/** @import { State } from '../core/state.js' */

/** Charts that are always available; `track` is the one whose quantity is selected in the bar. */
export const FIXED_CHARTS = {
  weights: 'weights',
  estimate: 'estimate',
  track: 'selected quantity',
};
export const DEFAULT_CHARTS = Object.keys(FIXED_CHARTS);

/**
 * Returns the keys of the charts from top to bottom; the default for an empty or unknown list.
 * @param {Pick<State, 'charts' | 'track'>} state
 * @param {readonly string[]} available keys beside the fixed ones
 */
export function chartKeys({ charts, track }, available) {
  const choices = new Set([...DEFAULT_CHARTS, ...available]);
  const keys = [...new Set(charts.split(','))].filter((key) => choices.has(key) && key !== track);
  return keys.length ? keys : DEFAULT_CHARTS;
}

/**
 * Returns a list of charts as text; empty for the default.
 * @param {readonly string[]} keys
 */
export const formatCharts = (keys) => (keys.join() === DEFAULT_CHARTS.join() ? '' : keys.join());

/**
 * Adds a chart at the end, or removes it; the last one remains.
 * @param {readonly string[]} keys
 * @param {string} key
 */
export function toggled(keys, key) {
  if (!keys.includes(key)) return [...keys, key];
  return keys.length > 1 ? keys.filter((other) => other !== key) : [...keys];
}

/**
 * Moves a chart by a number of places.
 * @param {readonly string[]} keys
 * @param {string} key
 * @param {number} places
 */
export function moved(keys, key, places) {
  const others = keys.filter((other) => other !== key);
  const index = Math.min(Math.max(keys.indexOf(key) + places, 0), others.length);
  return [...others.slice(0, index), key, ...others.slice(index)];
}
