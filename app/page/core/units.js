/** Number formats, and the conversion from the server's units to those of the page, such as cm and degrees. */

/** @import { Task } from '../types/server.js' */

import { LARGEST } from './constants.js';

/** @typedef {{unit: string, scale: number}} DisplayUnit scale: factor from the server's unit */

/**
 * Returns the display unit of a state component, with the degree sign for angles.
 * @param {{unit: string, display_unit: string, scale: number}} component
 * @returns {DisplayUnit}
 */
export const displayUnit = ({ unit, display_unit: displayed, scale }) => ({
  unit: unit === 'rad' ? '°' : displayed,
  scale,
});

/**
 * Returns the name of a column of numbers in files, such as hinge_x_cm.
 * @param {string} name
 * @param {string} unit may be empty
 */
export const columnName = (name, unit) => (unit ? `${name}_${unit}` : name);

/**
 * Returns the unit of a task's main error.
 * @param {Task} task
 */
export const mainUnit = ({ components, main }) => displayUnit(components[main.indices[0]]);

/**
 * Formats a value of the main error with its unit.
 * @param {Task} task
 * @param {number | null | undefined} value in units of the server
 */
export function mainText(task, value) {
  const { unit, scale } = mainUnit(task);
  return withUnit(fixed(value === null ? null : Number(value) * scale, 2), unit);
}

/**
 * Names what the main error is about: the object of hinge_x and hinge_y, or else the position or the component.
 * @param {Task} task
 */
export function mainName({ main, map }) {
  if (main.name !== 'position') return main.name;
  return /^(.+) x$/.exec(displayName(map.components[0]))?.[1] ?? main.name;
}

/**
 * Joins a text and a unit, which may be empty.
 * @param {string} text
 * @param {string} unit
 */
export const withUnit = (text, unit) =>
  unit.startsWith('°') && /\d$/.test(text) ? text + unit : `${text} ${unit}`.trim();

/**
 * Replaces the underscores of a name such as hinge_x by spaces.
 * @param {string} name
 */
export const displayName = (name) => name.replaceAll('_', ' ');

/**
 * Adds a capital and a full stop to a text that lacks them. Names such as door.h5 or hinge_x keep their first letter.
 * @param {string} text
 */
export function sentence(text) {
  const start = /^[a-z](?!\S*[._=/\d]\S)/.test(text) ? text[0].toUpperCase() : text.slice(0, 1);
  return start + text.slice(1) + (!text || /[.!?…]$/.test(text) ? '' : '.');
}

/**
 * Sets the numbers of a text of the server: minus signs in place of hyphens, but not in names and ranges; arrows; degrees.
 * @param {string} text
 */
export const typeset = (text) =>
  text
    .replace(/(?<![\w).:=-])-(?=\.?\d)/g, '−')
    .replaceAll(' -> ', ' → ')
    .replace(/(?<=\d) deg\b/g, '°')
    .replace(/\(deg\b/g, '(°');

const LARGE = 1e7; // numbers from here have an exponent, such as those of a filter that diverges

/** @param {number} value */
const exponential = (value) => value.toExponential(2).replaceAll('-', '−').replace('e+', 'e');

/**
 * Formats a number with fixed digits and a true minus sign; a dash for a missing number.
 * @param {number | null | undefined} value
 * @param {number} [digits]
 */
export function fixed(value, digits = 1) {
  if (value === null || value === undefined || !Number.isFinite(value)) return '–';
  if (Math.abs(value) >= LARGE) return exponential(value);
  const text = value.toFixed(digits);
  return /^-[0.]*$/.test(text) ? text.slice(1) : text.replace('-', '−');
}

/**
 * Formats a number as `fixed` does, with a sign also for positive numbers.
 * @param {number} value
 * @param {number} [digits]
 */
export const signed = (value, digits = 1) =>
  (value > 0 && Number(value.toFixed(digits)) > 0 ? '+' : '') + fixed(value, digits);

/**
 * Formats a number with three significant digits, an integer without decimals; a dash for a missing number.
 * @param {number | null | undefined} value
 */
export function significant(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return '–';
  const size = Math.abs(value);
  if (Number.isInteger(value) && size < 1e6) return fixed(value, 0);
  if (size >= 1e6 || size < 1e-4) return exponential(value);
  return fixed(value, Math.max(0, 2 - Math.floor(Math.log10(size))));
}

/**
 * Names a step, with its time where the data have timestamps: step 12, or step 12 (3.40 s).
 * @param {number} step
 * @param {number | null | undefined} time s
 */
export const stepLabel = (step, time) =>
  `step ${step}${Number.isFinite(time) ? ` (${fixed(time, 2)} s)` : ''}`;

/**
 * Formats a probability with two digits; none is certain.
 * @param {number} probability
 */
export const probabilityText = (probability) =>
  Number(probability.toFixed(2)) <= LARGEST ? probability.toFixed(2) : `above ${LARGEST}`;

/**
 * Returns a number with its noun: `1 episode`, `3 episodes`.
 * @param {number} count
 * @param {string} noun
 */
export const plural = (count, noun) => `${count} ${noun}${count === 1 ? '' : 's'}`;

/**
 * Formats a share from 0 to 1 in percent.
 * @param {number | null | undefined} share
 */
export const percent = (share) =>
  Number.isFinite(share) ? `${fixed(100 * Number(share), 0)} %` : '–';

/**
 * Wraps the difference of two angles to -180..180 degrees.
 * @param {number} degrees
 */
export const wrapDegrees = (degrees) => degrees - 360 * Math.round(degrees / 360);

/**
 * Returns the smallest of 1, 2 and 5 times a power of ten that is at least a value.
 * @param {number} value
 */
export function niceStep(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * ([1, 2, 5].find((factor) => factor * power >= value) ?? 10);
}

/**
 * Formats a size in bytes.
 * @param {number} count
 */
export function formatBytes(count) {
  if (count >= 1e9) return `${(count / 1e9).toFixed(1)} GB`;
  if (count < 1e3) return `${count} B`;
  return count >= 1e6 ? `${(count / 1e6).toFixed(1)} MB` : `${Math.round(count / 1e3)} kB`;
}
