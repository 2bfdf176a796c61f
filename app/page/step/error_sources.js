/** The parts of the error at each step by source: the sensors, the first belief and the dynamics. */

/** @import { Trace } from '../data/trace.js' */
/** @import { Curve } from '../types/server.js' */

import { MAX_STEPS, MIN_SHARE } from '../core/constants.js';
import { fixed, withUnit } from '../core/units.js';
import * as api from '../data/api.js';

const DIAGNOSTIC = 'sources';

/**
 * Returns a curve of the error and one of each source, which add up to it; none where they cannot be computed.
 * @param {Trace} trace
 * @param {AbortSignal} signal
 * @returns {Promise<Curve[]>}
 */
export async function loadErrorSources(trace, signal) {
  if (trace.live?.state === 'running' || trace.steps > MAX_STEPS) return [];
  const entries = await api.diagnostics(trace.selection, signal);
  if (entries.find(({ name }) => name === DIAGNOSTIC)?.why_not !== null) return [];
  return (await api.poll(api.diagnosticUrl(trace.selection, DIAGNOSTIC, {}), signal)).curves;
}

/**
 * Names the sources with a share of the error at a step, the largest parts first; empty if there is none.
 * @param {Curve[]} curves of the error and of each source
 * @param {number} step
 */
export function errorSourcesText([error, ...sources], step) {
  const parts = sources
    .map(({ name, values, unit }) => ({ name, unit, value: values[step] ?? 0 }))
    .filter(({ value }) => Math.abs(value) >= MIN_SHARE * (error.values[step] ?? Infinity))
    .sort((a, b) => b.value - a.value)
    .map(({ name, unit, value }) => `${name} ${withUnit(fixed(value, 2), unit)}`);
  return parts.length ? `By source: ${parts.join(', ')}.` : '';
}
