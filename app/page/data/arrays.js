/** Arrays over time: slices, growth and intervals. */

/** @import { Component } from '../types/api.js' */

/** @typedef {{data: Float32Array, shape: number[], channels?: Component[] | null}} Column steps first; `data` may have unused space at the end */
/** @typedef {Float32Array} Series one value per step */

/**
 * Decodes the header of a binary message: its length, and JSON (docs/api.md).
 * @param {ArrayBuffer} message
 * @returns {{header: any, end: number}} end: place of the data after it
 */
export function decodeHeader(message) {
  const length = new DataView(message).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(message, 4, length)));
  return { header, end: 4 + Math.ceil(length / 4) * 4 };
}

/**
 * Returns the number of values of a step in a column.
 * @param {number[]} shape
 */
export const stride = ([, ...rest]) => rest.reduce((a, b) => a * b, 1);

/**
 * Returns the values of a column over time at an index of the other axes.
 * @param {Column} column
 * @param {number[]} index
 */
export function slice({ data, shape }, index) {
  const [steps, ...rest] = shape;
  const [values, width] = [new Float32Array(steps), stride(shape)];
  let position = index.reduce((sum, i, axis) => sum * rest[axis] + i, 0);
  for (let t = 0; t < steps; t++, position += width) values[t] = data[position];
  return values;
}

/**
 * Returns an array with more values after the first `used` ones. It doubles its space if needed.
 * @template {Float32Array | Uint8Array} T
 * @param {T} array
 * @param {number} used
 * @param {T} values
 * @returns {T}
 */
export function append(array, used, values) {
  const size = used + values.length;
  if (array.length < size) {
    const previous = array;
    const Kind = /** @type {new (length: number) => T} */ (previous.constructor);
    array = new Kind(2 * size);
    array.set(previous.subarray(0, used));
  }
  array.set(values, used);
  return array;
}

/** @param {Iterable<number>} values */
export const sum = (values) => Array.from(values).reduce((a, b) => a + b, 0);

/**
 * Returns the length of vectors over time.
 * @param {(Series | undefined)[]} components
 */
export function norm(components) {
  return components[0]?.map((_, t) => Math.hypot(...components.map((c) => c?.[t] ?? NaN)));
}

/**
 * Returns the first and the last step of each interval where flags are set.
 * @param {ArrayLike<number | boolean>} flags
 * @returns {[number, number][]}
 */
export function intervals(flags) {
  /** @type {[number, number][]} */
  const result = [];
  for (let t = 0; t < flags.length; t++) {
    if (!flags[t]) continue;
    const start = t;
    while (t + 1 < flags.length && flags[t + 1]) t++;
    result.push([start, t]);
  }
  return result;
}
