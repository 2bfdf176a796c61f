/** Sparkline of the main error over an episode. */

/** @import { EpisodeErrors, Task } from '../types/server.js' */

import { svgElement } from '../core/dom.js';
import { mainText, stepLabel } from '../core/units.js';

const HEIGHT = 20; // in units of the view box
const QUANTILE = 0.95; // share of the episodes whose sparklines are not cut off

/**
 * Returns the error at the top of all sparklines.
 * @param {number[]} errors the largest ones of the episodes
 */
export function sparklineScale(errors) {
  const sorted = errors.sort((a, b) => a - b);
  return sorted[Math.ceil(QUANTILE * (sorted.length - 1))] ?? 0;
}

/**
 * @param {Task} task
 * @param {EpisodeErrors} errors
 * @param {number} scale error at the top
 * @param {(step: number, inputTime: number) => void} open called with the step that was clicked
 */
export function sparkline(task, errors, scale, open) {
  const { steps, error, contact, worst, worst_step: worstStep, worst_time: time } = errors;
  const description = `Largest error ${mainText(task, worst)}, at ${stepLabel(Number(worstStep), time)}`;
  const bands = contact.map((on, i) => (on ? `M${i} 0h1v${HEIGHT}h-1z` : ''));
  /** @param {number} value */
  const y = (value) => (HEIGHT - 1 - (HEIGHT - 2) * Math.min(1, value / scale)).toFixed(2);
  const line = error.map((value, i) => {
    if (value === null) return '';
    return `${i && error[i - 1] !== null ? 'L' : 'M'}${i + 0.5} ${y(value)}`;
  });
  const viewBox = `0 0 ${error.length} ${HEIGHT}`;
  const svg = svgElement(
    'svg',
    { viewBox, preserveAspectRatio: 'none', role: 'img', 'aria-label': description },
    svgElement('path', { class: 'contact', d: bands.join('') || 'M0 0' }),
    svgElement('path', { class: 'error', d: line.join('') || 'M0 0' }),
    svgElement('title', {}, description),
  );
  svg.addEventListener('click', ({ clientX, timeStamp }) => {
    const { left, width } = svg.getBoundingClientRect();
    const step = Math.floor((steps * (clientX - left)) / width);
    open(Math.max(0, Math.min(step, steps - 1)), timeStamp);
  });
  return svg;
}
