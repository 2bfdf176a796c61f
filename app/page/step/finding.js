/** The outage of a run in words. */

/** @import { Trace } from '../data/trace.js' */

import { fixed, percent } from '../core/units.js';
import { intervals } from '../data/arrays.js';

const MIN_STEPS = 5; // of an outage
const BEFORE = 10; // steps that are compared with the outage

/**
 * Describes the first outage of the camera that begins in contact; empty if there is none.
 * @param {Trace} trace
 * @param {number} component whose effective weights are described
 */
export function outageFinding(trace, component) {
  const outage = intervals(trace.blackout).find(
    ([first, last]) => first && trace.contact[first] && last - first >= MIN_STEPS - 1,
  );
  if (!outage) return '';
  const [first, last] = outage;
  const parts = [`The camera goes dark at step ${first}, in contact`];
  for (const name of trace.modalities.filter((modality) => modality !== 'image')) {
    const weights = trace.weight('effective', name, component);
    if (!weights) continue;
    const before = mean(weights.subarray(Math.max(0, first - BEFORE), first));
    const during = mean(weights.subarray(first, last + 1));
    const verb = during > before ? 'rises' : 'falls';
    parts.push(
      `the effective weight of ${name} ${verb} from ${percent(before)} to ${percent(during)}`,
    );
  }
  const errors = trace.error('fused', 'position')?.subarray(first, last + 1) ?? [NaN];
  const worst = Math.max(...errors);
  if (worst >= 0)
    parts.push(`the position error stays below ${fixed(Math.ceil(10 * worst) / 10)} cm`);
  const end = last + 1 < trace.steps ? `the image returns at step ${last + 1}` : 'it stays dark';
  return `${parts.join('; ')}; ${end}.`;
}

/** @param {ArrayLike<number>} values */
const mean = (values) => Array.from(values).reduce((sum, value) => sum + value, 0) / values.length;
