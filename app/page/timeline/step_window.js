/** The visible steps of the timeline. */

/** @typedef {[from: number, to: number]} StepWindow with fractions */

const MIN_STEPS = 8; // visible at the strongest zoom

/** @param {number} step */
const format = (step) => String(Number(step.toFixed(1)));

/**
 * Fits a window into the available steps.
 * @param {StepWindow} window
 * @param {StepWindow} all
 * @returns {StepWindow}
 */
export function fitWindow([from, to], [first, last]) {
  const span = Math.min(Math.max(to - from, Math.min(MIN_STEPS, last)), last - first);
  const start = Math.min(Math.max(from, first), last - span);
  return [start, start + span];
}

/**
 * Scales a window around a step, which keeps its place if it is visible.
 * @param {StepWindow} window
 * @param {number} step
 * @param {number} factor
 * @returns {StepWindow}
 */
export function zoomWindow([from, to], step, factor) {
  const centre = Math.min(Math.max(step, from), to);
  return [centre - (centre - from) * factor, centre + (to - centre) * factor];
}

/**
 * Writes a window as text; empty if it contains all steps.
 * @param {StepWindow} window
 * @param {StepWindow} all
 */
export const formatWindow = ([from, to], [first, last]) =>
  to - from >= last - first ? '' : `${format(from)}-${format(to)}`;

/**
 * Reads a window from text.
 * @param {string} text
 * @param {StepWindow} all for an empty text
 * @returns {StepWindow}
 */
export function parseWindow(text, all) {
  if (!text) return all;
  const [from, to] = text.split('-').map(Number);
  return [from, to];
}
