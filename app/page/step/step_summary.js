/** Sentences that summarise a step: error, consistency and the dominant modality. */

/** @import { Trace } from '../data/trace.js' */

import { MAX_SIGMAS } from '../core/constants.js';
import { displayName, fixed, percent, withUnit } from '../core/units.js';
import { updateLabel } from '../data/trace.js';

const DOMINANT_SHARE = 0.6; // effective weight from which a modality is dominant
const FEW_PARTICLES = 0.05; // share of the particles
/** Predicted standard deviations: an update that moves the prediction by less in each component nearly keeps it. */
const SMALL_UPDATE = 0.5;
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
  const sentences = [text];
  const dominant = dominantModality(trace, step, component);
  if (dominant) {
    const uninformative = uninformativeReason(dominant.name, trace, step);
    const better = moreAccurateModality(dominant.name, trace, step, tone);
    if (dominant.weight >= DOMINANT_SHARE || better) {
      const scope = weightScope(trace, component);
      // A small update of an accurate estimate may confirm it; that of an inaccurate one does not correct it.
      const isSmall =
        (tone === 'warn' || tone === 'bad' || better) &&
        keepsPrediction(dominant.name, trace, step, component);
      const update = isSmall
        ? `, which nearly keeps the prediction${uninformative && ` as ${uninformative}`}`
        : '';
      const reasons = [isSmall ? '' : uninformative, better].filter(Boolean).join(' and ');
      sentences.push(
        `Dominated by ${displayName(dominant.name)} (${percent(dominant.weight)}${scope})${update}${reasons && `, although ${reasons}`}.`,
      );
    }
  }
  if (trace.blackout[step] && dominant?.name !== 'image') sentences.push('Image blacked out.');
  const size = trace.effectiveSampleSize?.[step];
  const count = trace.header.settings?.particles;
  if (size && count && size < FEW_PARTICLES * count)
    sentences.push(`Effective sample size ${fixed(size, 0)} of ${count} particles.`);
  if (sources) sentences.push(sources);
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
  const [estimate, quantity] = trace.fuses
    ? ['Fused estimate', 'Fused error']
    : ['Estimate', 'Error'];
  const value = trace.error('fused', 'main')?.[step];
  if (value === undefined || !Number.isFinite(value))
    return { tone: 'bad', text: `${estimate}: not a finite number.` };
  const error = `${quantity} ${withUnit(fixed(value, 2), trace.mainUnit)}`;
  const deviation = trace.largestDeviation(step);
  if (!deviation) return { tone: 'none', text: `${error}, no predicted standard deviation.` };
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
      ? ['good', 'as predicted']
      : sigmas <= 2 * consistent
        ? ['warn', 'larger than predicted']
        : ['bad', 'overconfident'];
  const text = `${error}, ${fixed(sigmas, 1)}σ in ${displayName(component)}: ${verdict}.`;
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
 * Returns whether the single-modality update of a modality nearly keeps the prediction: in the component whose weights
 * are compared, or in all of them if they have one weight.
 * @param {string} modality
 * @param {Trace} trace
 * @param {number} step
 * @param {number} component
 */
function keepsPrediction(modality, trace, step, component) {
  const components = trace.weightWidth > 1 ? [component] : trace.components.keys();
  return [...components].every(
    (i) => (trace.updateSize(modality, i)?.[step] ?? NaN) < SMALL_UPDATE,
  );
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
  return `the ${updateLabel(best.name)} errs by ${withUnit(fixed(best.error, 2), trace.mainUnit)}`;
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
