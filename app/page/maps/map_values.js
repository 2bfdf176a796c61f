/** The likelihood maps as they arrive (docs/api.md), and what is made of their cells: shades, ranges, regions, differences. */

import { fixed, signed } from '../core/units.js';

/**
 * @typedef {object} Maps of one step
 * @property {number} serial @property {boolean} other whether they are of the other run @property {Maps | null} beside the other run's at this step
 * @property {number} step @property {number} size cells a side, S @property {number | null} angle rad
 * @property {string[]} layers L names @property {number} half_width m @property {number[]} centre m @property {number[]} truth
 * @property {number[]} estimate @property {number[]} log_max @property {number[]} log_range nats below the peak that are told apart
 * @property {number[][]} peak m, offsets @property {number[] | null} effector m
 * @property {Record<string, any>} numbers of `MapNumbers`, by layer
 * @property {Float32Array} positions M x 2 m, of particles @property {Float32Array[]} weights (M,) by layer
 * @property {Uint16Array[]} cells S x S by layer; row 0 is the smallest y offset
 */

const STEPS = 65535;
const DEEPEST = 64; // nats: a layer with this range has cells that are as deep or deeper
const decoder = new TextDecoder();

/** @param {ArrayBuffer} buffer @returns {Maps} */
export function readMaps(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const maps = JSON.parse(decoder.decode(new Uint8Array(buffer, 4, length)));
  let at = 4 + Math.ceil(length / 4) * 4;
  const take = (Kind, count) => {
    const array = new Kind(buffer, at, count);
    at += array.byteLength;
    return array;
  };
  const { particles, layers, size } = maps;
  maps.positions = take(Float32Array, 2 * particles);
  maps.weights = layers.map(() => take(Float32Array, particles));
  maps.cells = layers.map(() => take(Uint16Array, size * size));
  return maps;
}

/** What the cells of one layer are shown as. @typedef {{values: Float32Array, low: number, high: number, deep: boolean}} Shade deep: some lie below `low` */

const SHOWN = { log: 40, ratio: 12 }; // nats between the ends of the colours at most

/**
 * The layers as they are coloured.
 * @param {Maps} maps @param {'normalised' | 'log'} scale likelihood relative to the peak, or its logarithm
 * @param {'own' | 'same'} range each layer its own, or all that of the highest @param {Maps | null} pinned to take the ratio to
 * @returns {Shade[]}
 */
export function shades(maps, scale, range, pinned) {
  if (pinned) return ratios(maps, pinned, range);
  const logs = maps.cells.map((_, layer) => log(maps, layer));
  const top = Math.max(...maps.log_max);
  const bottom = Math.min(...maps.log_max.map((max, l) => max - maps.log_range[l]));
  return logs.map((values, l) => {
    const peak = range === 'same' ? top : maps.log_max[l];
    if (scale === 'normalised') return { values: values.map((v) => Math.exp(v - peak)), low: 0, high: 1, deep: false };
    const lowest = range === 'same' ? bottom : peak - maps.log_range[l];
    const low = Math.max(lowest, peak - SHOWN.log);
    return { values, low, high: peak, deep: low > lowest || maps.log_range[l] >= DEEPEST };
  });
}

/** (S x S) log-likelihood, nats. @param {Maps} maps */
export function log(maps, layer) {
  const [cells, max, span] = [maps.cells[layer], maps.log_max[layer], maps.log_range[layer]];
  const values = new Float32Array(cells.length);
  for (let i = 0; i < cells.length; i++) values[i] = max + span * (cells[i] / STEPS - 1);
  return values;
}

/** How much more likely a place is than in the pinned maps: the logarithm of two densities' ratio, over the offsets from the truth. */
function ratios(maps, pinned, range) {
  const found = maps.layers.map((_, l) => {
    const [now, then] = [log(maps, l), log(pinned, l)];
    const constant = Math.log(mass(then)) - 2 * Math.log(pinned.size) - Math.log(mass(now)) + 2 * Math.log(maps.size);
    return now.map((v, i) => v - then[same(i, maps.size, pinned.size)] + constant);
  });
  const most = found.map((values) => values.reduce((high, v) => Math.max(high, Math.abs(v)), 1e-3));
  return found.map((values, l) => {
    const wanted = range === 'same' ? Math.max(...most) : most[l];
    const high = Math.min(wanted, SHOWN.ratio);
    return { values, low: -high, high, deep: wanted > high };
  });
}

const mass = (logs) => logs.reduce((sum, v) => sum + Math.exp(v), 0);

/** The cell of a map with another number of cells that lies at the same place. */
function same(cell, size, other) {
  const at = (index) => Math.min(Math.floor(((index + 0.5) / size) * other), other - 1);
  return at(Math.floor(cell / size)) * other + at(cell % size);
}

/** The cell at an offset. @param {number[]} offset m from the truth */
export function cellAt(maps, [dx, dy]) {
  const at = (d) => Math.min(Math.max(Math.floor(((d + maps.half_width) / (2 * maps.half_width)) * maps.size), 0), maps.size - 1);
  return at(dy) * maps.size + at(dx);
}

/** What stands at the ends of a shade's colour bar. @returns {[string, string]} */
export function ends({ low, high, deep }, digits) {
  if (low === 0) return ['0', '1'];
  const beyond = deep && high === -low ? '≥' : ''; // a ratio
  return [`${deep ? '≤' : ''}${fixed(low, digits)}`, `${beyond}${low === -high ? signed(high, digits) : fixed(high, digits)}`];
}

/** Digits that tell the ends of a shade's colours apart. @param {Shade} shade */
export const digits = ({ low, high }) => (high - low < 0.2 ? 3 : high - low < 2 ? 2 : high - low < 8 ? 1 : 0);

/** One cell's value. @returns {{log: number, relative: number, deep: boolean}} deep: it may be less */
export function valueAt(maps, layer, cell) {
  const below = maps.log_range[layer] * (maps.cells[layer][cell] / STEPS - 1);
  const deep = maps.cells[layer][cell] === 0 && maps.log_range[layer] >= DEEPEST;
  return { log: maps.log_max[layer] + below, relative: Math.exp(below), deep };
}

/** The borders of the smallest regions that hold such shares of the likelihood, as line segments x0, y0, x1, y1 from 0 to 1, y up.
 *  @param {number[]} shares @returns {number[][]} */
export function borders(maps, layer, shares) {
  const [cells, span] = [maps.cells[layer], maps.log_range[layer]];
  const ordered = cells.slice().sort();
  const likelihood = new Float64Array(ordered.length);
  let total = 0;
  for (let i = 0; i < ordered.length; i++) total += likelihood[i] = Math.exp(span * (ordered[i] / STEPS - 1));
  return shares.map((share) => {
    let [held, i] = [0, ordered.length];
    while (i > 0 && held < share * total) held += likelihood[--i];
    return contour(cells, maps.size, ordered[i] - 0.5);
  });
}

/** Sides of a square between four cell centres that a border crosses, by which corners lie inside (1, 2, 4, 8 from below left, round). */
const CROSSED = [[], [3, 0], [0, 1], [3, 1], [1, 2], [3, 0, 1, 2], [0, 2], [3, 2], [2, 3], [2, 0], [0, 1, 2, 3], [2, 1], [1, 3], [1, 0], [0, 3], []];

/** Marching squares. */
function contour(cells, size, level) {
  const segments = [];
  for (let row = 0; row < size - 1; row++) {
    for (let column = 0; column < size - 1; column++) {
      const i = row * size + column;
      const [a, b, c, d] = [cells[i], cells[i + 1], cells[i + size + 1], cells[i + size]];
      for (const side of CROSSED[(a > level) | ((b > level) << 1) | ((c > level) << 2) | ((d > level) << 3)]) {
        const between = (from, to) => 0.5 + (level - from) / (to - from);
        const [x, y] = [[between(a, b), 0.5], [1.5, between(b, c)], [between(d, c), 1.5], [0.5, between(a, d)]][side];
        segments.push((column + x) / size, (row + y) / size);
      }
    }
  }
  return segments;
}
