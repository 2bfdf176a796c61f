/** A sentence that summarises a step: error, consistency and the dominant modality. */

/** @import { Trace } from '../data/trace.js' */

import { MAX_SIGMAS } from '../core/constants.js';
import { displayName, fixed, percent, withUnit } from '../core/units.js';
import { updateLabel } from '../data/trace.js';

const DOMINANT_SHARE = 0.6; // effective weight from which a modality is dominant
const FEW_PARTICLES = 0.05; // share of the particles
/** Another estimate counts as more accurate if its error is lower by this many units for display, and by this factor. */
const MIN_GAIN = { consistent: 1, other: 0.2 };
const MAX_RATIO = 0.8;

/** @typedef {'good' | 'warn' | 'bad' | 'none'} Tone */

/**
 * @param {Trace} trace
 * @param {number} step
 * @param {number} component whose effective weights are compared
 * @param {string} [sources] of the error, in words
 * @returns {{tone: Tone, text: string}}
 */
export function stepSummary(trace, step, component, sources = '') {
  const { tone, text } = trace.hasTruth(step)
    ? accuracy(trace, step)
    : { tone: /** @type {Tone} */ ('none'), text: 'True state unknown.' };
  const sentences = [text, sources].filter(Boolean);
  const dominant = dominantModality(trace, step, component);
  if (dominant) {
    const uninformative = uninformativeReason(dominant.name, trace, step);
    const better = moreAccurateModality(dominant.name, trace, step, tone);
    if (dominant.weight >= DOMINANT_SHARE || better) {
      const scope = weightScope(trace, component);
      const reasons = [uninformative, better].filter(Boolean).join(' and ');
      sentences.push(
        `Dominated by ${displayName(dominant.name)} (${percent(dominant.weight)}${scope})${reasons && `, although ${reasons}`}.`,
      );
    }
  }
  if (trace.blackout[step] && dominant?.name !== 'image') sentences.push('Image blacked out.');
  const size = trace.effectiveSampleSize?.[step];
  const count = trace.header.settings?.particles;
  if (size && count && size < FEW_PARTICLES * count)
    sentences.push(`Effective sample size ${fixed(size, 0)} of ${count} particles.`);
  return { tone, text: sentences.join(' ') };
}

/**
 * Returns `` in hinge x`` where the weights of components differ, else an empty text.
 * @param {Trace} trace
 * @param {number} component
 */
export const weightScope = (trace, component) =>
  trace.weightWidth > 1 ? ` in ${displayName(trace.components[component].name)}` : '';

/**
 * Compares the error of the estimate with its predicted standard deviation.
 * @param {Trace} trace
 * @param {number} step
 * @returns {{tone: Tone, text: string}}
 */
function accuracy(trace, step) {
  const name = trace.fuses ? 'Fused estimate' : 'Estimate';
  const value = trace.error('fused', 'main')?.[step];
  if (value === undefined || !Number.isFinite(value))
    return { tone: 'bad', text: `${name}: not a finite number.` };
  const error = `${name}: error ${withUnit(fixed(value, 2), trace.mainUnit)}`;
  const deviation = trace.largestDeviation(step);
  if (!deviation) return { tone: 'none', text: `${error}; no predicted standard deviation.` };
  const { sigmas, component } = deviation;
  if (sigmas === Infinity)
    return {
      tone: 'bad',
      text: `${error}; the predicted variance of ${displayName(component)} is not positive.`,
    };
  // The largest of several deviations is larger than one of them.
  const consistent = Math.sqrt(MAX_SIGMAS ** 2 + 2 * Math.log(trace.components.length));
  /** @type {[Tone, string]} */
  const [tone, verdict] =
    sigmas <= consistent
      ? ['good', 'consistent']
      : sigmas <= 2 * consistent
        ? ['warn', 'larger than predicted']
        : ['bad', 'overconfident'];
  const text = `${error}; largest deviation ${fixed(sigmas, 1)}σ in ${displayName(component)}: ${verdict}.`;
  return { tone, text };
}

/**
 * Explains why a modality carries no information at a step; empty if it may.
 * @param {string} modality
 * @param {Trace} trace
 * @param {number} step
 */
function uninformativeReason(modality, trace, step) {
  if (modality === 'image' && trace.blackout[step]) return 'the image is blacked out';
  return modality === 'haptics' && !trace.contact[step] ? 'there is no contact' : '';
}

/**
 * Describes the most accurate single-modality update if it is clearly more accurate than the fused estimate.
 * @param {string} dominant modality
 * @param {Trace} trace
 * @param {number} step
 * @param {Tone} tone
 */
function moreAccurateModality(dominant, trace, step, tone) {
  const best = mostAccurateModality(trace, step);
  const error = trace.error('fused', 'main')?.[step] ?? NaN;
  const gain = tone === 'good' ? MIN_GAIN.consistent : MIN_GAIN.other;
  if (!best || best.name === dominant) return '';
  if (!(best.error < Math.min(error - gain, MAX_RATIO * error))) return '';
  return `the error of the ${updateLabel(best.name)} is ${withUnit(fixed(best.error, 2), trace.mainUnit)}`;
}

/**
 * @param {Trace} trace
 * @param {number} step
 */
function mostAccurateModality(trace, step) {
  const modalities = trace.has('modality_mean') ? trace.modalities : [];
  const errors = modalities.map((name) => ({
    name,
    error: trace.error(name, 'main')?.[step] ?? NaN,
  }));
  return errors.sort((a, b) => a.error - b.error)[0];
}

/**
 * @param {Trace} trace
 * @param {number} step
 * @param {number} component
 */
function dominantModality(trace, step, component) {
  const weights = trace.modalities.flatMap((name) => {
    const weight = trace.weight('effective', name, component)?.[step];
    return weight === undefined ? [] : [{ name, weight }];
  });
  return weights.sort((a, b) => b.weight - a.weight)[0];
}
