/** Failure scores: names, units, and the view of the page that displays a score. */

/** @import { State } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { FailureScore } from '../types/server.js' */

import { significant } from '../core/units.js';

/** @type {Record<string, string>} */
const NAMES = { nees: 'NEES/n', ess: 'ESS' };
/** @type {Record<string, {unit: string, scale: number}>} */
const UNITS = {
  rad: { unit: '°', scale: 180 / Math.PI },
  sigma: { unit: 'σ', scale: 1 },
  x: { unit: '×', scale: 1 },
};
/** Changes of the state that display a score in the timeline. @type {Record<string, Partial<State>>} */
const VIEWS = {
  error: { track: 'error' },
  nees: { track: 'nees' },
  ess: { track: 'particles' },
  regret: { weights: 'effective' },
};

/** @param {FailureScore} score */
export const scoreName = ({ name }) => NAMES[name] ?? name.replaceAll('_', ' ');

/**
 * Returns the unit that the page displays, and its factor.
 * @param {FailureScore} score
 */
export const scoreUnit = ({ unit, display_unit: displayed, scale }) =>
  UNITS[unit] ?? { unit: displayed, scale };

/**
 * Formats a value of a score with its unit.
 * @param {FailureScore} score
 * @param {number | null} value
 */
export function formatScore(score, value) {
  const { unit, scale } = scoreUnit(score);
  return `${significant(value === null ? null : scale * value)}${unit && ' '}${unit}`;
}

/**
 * Returns the changes of the state that display a score in the timeline.
 * @param {string} name of the score
 * @param {Trace | null} trace
 * @returns {Partial<State>}
 */
export function viewOf(name, trace) {
  if (trace?.components.some((component) => component.name === name))
    return { component: name, track: 'error' };
  return VIEWS[name] ?? {};
}
