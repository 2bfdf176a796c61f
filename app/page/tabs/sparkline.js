/** Sparkline of the main error over an episode. */

/** @import { EpisodeErrors, Task } from '../types/server.js' */

import { mainText, stepLabel } from '../core/units.js';

const SVG = 'http://www.w3.org/2000/svg';
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
  const svg = document.createElementNS(SVG, 'svg');
  const description = `Largest error ${mainText(task, worst)}, at ${stepLabel(Number(worstStep), time)}`;
  svg.setAttribute('viewBox', `0 0 ${error.length} ${HEIGHT}`);
  svg.setAttribute('preserveAspectRatio', 'none');
  svg.setAttribute('role', 'img');
  svg.setAttribute('aria-label', description);
  const title = document.createElementNS(SVG, 'title');
  title.textContent = description;
  const bands = contact.map((on, i) => (on ? `M${i} 0h1v${HEIGHT}h-1z` : ''));
  /** @param {number} value */
  const y = (value) => (HEIGHT - 1 - (HEIGHT - 2) * Math.min(1, value / scale)).toFixed(2);
  const line = error.map((value, i) => {
    if (value === null) return '';
    return `${i && error[i - 1] !== null ? 'L' : 'M'}${i + 0.5} ${y(value)}`;
  });
  svg.append(path('contact', bands.join('')), path('error', line.join('')), title);
  svg.addEventListener('click', ({ clientX, timeStamp }) => {
    const { left, width } = svg.getBoundingClientRect();
    const step = Math.floor((steps * (clientX - left)) / width);
    open(Math.max(0, Math.min(step, steps - 1)), timeStamp);
  });
  return svg;
}

/**
 * @param {string} className
 * @param {string} commands
 */
function path(className, commands) {
  const node = document.createElementNS(SVG, 'path');
  node.setAttribute('class', className);
  node.setAttribute('d', commands || 'M0 0');
  return node;
}
