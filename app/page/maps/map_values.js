/** Likelihood maps as the server sends them (docs/api.md), and the values that the page displays: colours, regions, differences. */

/** @import { DisplayUnit } from '../core/units.js' */

import { CELL_STEPS, LOG_RANGE } from '../core/constants.js';
import { decodeHeader } from '../data/arrays.js';
import { displayUnit, fixed, signed, wrapDegrees } from '../core/units.js';

/**
 * @typedef {object} MapStatistics measures of each layer; null where a measure does not exist
 * @property {(number | null)[]} truth log-likelihood at the true position, relative to the peak
 * @property {number[][]} mean offsets of the mean from the centre
 * @property {number[]} entropy nats, of a density per area in the units of the axes
 * @property {number[]} area50 in the units of the axes
 * @property {number[]} area95
 * @property {(number | null)[]} axis rad, direction of the long axis
 * @property {(number | null)[]} elongation length of the long axis over the short one
 * @property {(number | null)[]} deviation rad between the long axis and the direction of the ridge that the task expects
 * @property {(number | null)[][]} ring_centre m, centre of the circle fitted to the 50 % region, as an offset from the truth
 * @property {(number | null)[]} ring_radius m
 * @property {number[]} ring_coverage part of the circle in the 50 % region, 0 to 1
 * @property {(number | null)[][]} divergence nats, from layer to layer
 * @property {(number | null)[][]} overlap
 *
 * @typedef {object} Maps of one step
 * @property {number} serial
 * @property {boolean} other whether they belong to the comparison run
 * @property {Maps | null} beside maps of the comparison run at the same step
 * @property {number} step
 * @property {number} size S, cells along a side
 * @property {number} rows S, or 1 for a curve over one component
 * @property {'likelihood' | 'posterior'} quantity
 * @property {string} rule of the fused layer
 * @property {number | null} angle SI, value of the only component off the map; null if there is none or it is integrated out
 * @property {number | null} expected rad, direction of the ridge that the task expects
 * @property {('flat' | 'round' | 'ridge' | 'ring' | 'cut by border' | null)[]} shape of each layer; null where the axes have different units
 * @property {string[]} layers L names
 * @property {MapAxis[]} axes x and y, or one of a curve
 * @property {'fixed' | 'marginal'} others treatment of the components off the map
 * @property {string} note the same in words, empty if only one component is fixed
 * @property {number[]} centre
 * @property {(number | null)[]} truth state
 * @property {number[]} estimate state
 * @property {number[]} log_max log-likelihood of the peaks
 * @property {number[]} log_range nats from the peak to the lowest cell
 * @property {number[][]} peak offsets from the centre
 * @property {number[] | null} effector m
 * @property {MapStatistics} numbers
 * @property {number} particles M
 * @property {Float32Array} positions M x 2, of the particles
 * @property {Float32Array[]} weights L x M
 * @property {Uint16Array[]} cells L x rows x S; row 0 has the smallest y offset
 *
 * @typedef {object} MapAxis a state component
 * @property {string} name
 * @property {number} index in the state
 * @property {string} unit of values
 * @property {string} display_unit unit for display
 * @property {number} scale factor from `unit` to `display_unit`
 * @property {number} half_width half the extent, in `unit`
 *
 * @typedef {'normalised' | 'log'} Scale likelihood relative to the peak, or its logarithm
 * @typedef {'own' | 'same'} Range of the colours: of each layer, or common to all
 * @typedef {{values: Float32Array, low: number, high: number, clipped: boolean}} Shade
 *   values of a layer and the ends of its colours; clipped: some values are below `low`
 */

const MAX_RANGE = { log: 40, ratio: 12 }; // nats between the ends of the colours
export const REGION_SHARES = [0.5, 0.95]; // of the likelihood within the borders on maps

/**
 * Decodes a message with maps.
 * @param {ArrayBuffer} buffer
 * @returns {Maps}
 */
export function readMaps(buffer) {
  let { header: maps, end: offset } = decodeHeader(buffer);
  const { particles, layers, size, rows } = maps;
  /** @param {number} count */
  const floats = (count) => {
    const array = new Float32Array(buffer, offset, count);
    offset += array.byteLength;
    return array;
  };
  const positions = floats(2 * particles);
  const weights = layers.map(() => floats(particles));
  /** @type {Uint16Array[]} */
  const cells = layers.map(
    (/** @type {string} */ _, /** @type {number} */ layer) =>
      new Uint16Array(buffer, offset + 2 * layer * size * rows, size * rows),
  );
  return { ...maps, positions, weights, cells, beside: null };
}

/**
 * Returns the values and the colour range of each layer.
 * @param {Maps} maps
 * @param {Scale} scale
 * @param {Range} range
 * @param {Maps | null} reference for likelihood ratios; null for likelihoods
 * @returns {Shade[]}
 */
export function shades(maps, scale, range, reference) {
  if (reference) return ratios(maps, reference, range);
  const logs = maps.cells.map((_, layer) => logLikelihood(maps, layer));
  const top = Math.max(...maps.log_max);
  const bottom = Math.min(...maps.log_max.map((max, layer) => max - maps.log_range[layer]));
  return logs.map((values, layer) => {
    const high = range === 'same' ? top : maps.log_max[layer];
    if (scale === 'normalised')
      return { values: values.map((v) => Math.exp(v - high)), low: 0, high: 1, clipped: false };
    const lowest = range === 'same' ? bottom : high - maps.log_range[layer];
    const low = Math.max(lowest, high - MAX_RANGE.log);
    return { values, low, high, clipped: low > lowest || maps.log_range[layer] >= LOG_RANGE };
  });
}

/**
 * Returns the colours of a layer relative to its own peak or to the highest one of its step, with the same ends for all
 * layers and steps.
 * @param {Maps} maps
 * @param {number} layer
 * @param {Scale} scale
 * @param {Range} range
 * @returns {Shade}
 */
export function tileShade(maps, layer, scale, range) {
  const [cells, span] = [maps.cells[layer], maps.log_range[layer]];
  const peak = range === 'same' ? maps.log_max[layer] - Math.max(...maps.log_max) : 0;
  const values = Float32Array.from(cells, (cell) => peak + span * (cell / CELL_STEPS - 1));
  if (scale === 'log') return { values, low: -MAX_RANGE.log, high: 0, clipped: true };
  return { values: values.map(Math.exp), low: 0, high: 1, clipped: false };
}

const TILES_AROUND = 6;
const TILE_SPACINGS = 20; // of the run, between tiles around the cursor

/**
 * Returns the steps of small maps: the last one in free motion and the first one in contact, and six around the cursor.
 * While the cursor moves, most of these steps stay the same.
 * @param {ArrayLike<number | boolean>} contact
 * @param {number} step of the cursor
 * @returns {{step: number, phase: 'contact' | 'free' | '', pair: boolean}[]} phase: empty in a run without contact
 */
export function tileSteps(contact, step) {
  const spacing = Math.max(1, Math.round(contact.length / TILE_SPACINGS));
  const count = Math.floor((contact.length - 1) / spacing) + 1;
  const before = Math.floor(step / spacing) - Math.floor(TILES_AROUND / 2) + 1;
  const first = Math.max(0, Math.min(before, count - TILES_AROUND));
  const around = Array.from(
    { length: Math.min(TILES_AROUND, count) },
    (_, i) => (first + i) * spacing,
  );
  const distances = around.map((other) => Math.abs(other - step));
  around[distances.indexOf(Math.min(...distances))] = step;
  const hasContact = Array.from(contact).some(Boolean);
  const onset = Array.from(contact).findIndex((value, t) => t > 0 && value && !contact[t - 1]);
  const pair = onset > 0 ? [onset - 1, onset] : [];
  return [...pair, ...around].map((t, i) => ({
    step: t,
    phase: contact[t] ? 'contact' : hasContact ? 'free' : '',
    pair: i < pair.length,
  }));
}

/**
 * Returns the log-likelihood of the cells of a layer.
 * @param {Maps} maps
 * @param {number} layer
 */
export function logLikelihood(maps, layer) {
  const [cells, max, span] = [maps.cells[layer], maps.log_max[layer], maps.log_range[layer]];
  const values = new Float32Array(cells.length);
  for (let i = 0; i < cells.length; i++) values[i] = max + span * (cells[i] / CELL_STEPS - 1);
  return values;
}

/**
 * Returns the logarithm of the ratio of two densities at the same offsets from the truth.
 * @param {Maps} maps
 * @param {Maps} reference
 * @param {Range} range
 * @returns {Shade[]}
 */
function ratios(maps, reference, range) {
  const layers = maps.layers.map((_, layer) => {
    const logs = logLikelihood(maps, layer);
    const referenceLogs = logLikelihood(reference, layer);
    const constant =
      Math.log(mass(referenceLogs)) -
      Math.log(referenceLogs.length) -
      Math.log(mass(logs)) +
      Math.log(logs.length);
    return logs.map((v, i) => v - referenceLogs[matchingCell(i, maps, reference)] + constant);
  });
  const extremes = layers.map((values) =>
    values.reduce((max, v) => Math.max(max, Math.abs(v)), 1e-3),
  );
  return layers.map((values, layer) => {
    const extreme = range === 'same' ? Math.max(...extremes) : extremes[layer];
    const high = Math.min(extreme, MAX_RANGE.ratio);
    return { values, low: -high, high, clipped: extreme > high };
  });
}

/** @param {Float32Array} logs */
const mass = (logs) => logs.reduce((sum, v) => sum + Math.exp(v), 0);

/**
 * Returns the cell at the same place of a map of another size.
 * @param {number} cell
 * @param {Maps} maps
 * @param {Maps} other
 */
function matchingCell(cell, { size, rows }, other) {
  /** @param {number} index @param {number} from @param {number} to */
  const match = (index, from, to) => Math.min(Math.floor(((index + 0.5) / from) * to), to - 1);
  const row = match(Math.floor(cell / size), rows, other.rows);
  return row * other.size + match(cell % size, size, other.size);
}

/**
 * Returns the cell at an offset from the truth.
 * @param {{size: number, axes: Pick<MapAxis, 'half_width'>[]}} maps
 * @param {number[]} offset
 */
export function cellAt({ size, axes }, offset) {
  const [column, row = 0] = offset.map((d, i) => {
    const { half_width: half } = axes[i];
    return Math.min(Math.max(Math.floor(((d + half) / (2 * half)) * size), 0), size - 1);
  });
  return row * size + column;
}

/**
 * Returns a position as offsets from the centre of maps, with angles wrapped.
 * @param {Pick<Maps, 'axes' | 'centre'>} maps
 * @param {number[]} position
 */
export const offsetOf = ({ axes, centre }, position) =>
  position.map((value, i) => {
    const offset = value - centre[i];
    return axes[i].unit === 'rad'
      ? wrapDegrees((offset * 180) / Math.PI) * (Math.PI / 180)
      : offset;
  });

/**
 * Returns the offset of the estimate from the centre if it is off the maps; null otherwise.
 * @param {Pick<Maps, 'axes' | 'centre' | 'estimate'>} maps
 */
export function offsetOffMap(maps) {
  const { axes, estimate } = maps;
  const position = axes.map(({ index }) => estimate[index]);
  const offset = offsetOf(maps, position);
  return offset.some((d, i) => Math.abs(d) > axes[i].half_width) ? offset : null;
}

/**
 * Returns whether maps are curves over one component.
 * @param {Pick<Maps, 'axes'>} maps
 */
export const isCurve = ({ axes }) => axes.length === 1;

/**
 * Returns the unit of an area of the maps, or of a length on curves, and the factor from its SI unit.
 * @param {MapAxis[]} axes
 * @returns {DisplayUnit}
 */
export function areaUnit([x, y]) {
  const [unit, other] = [displayUnit(x), displayUnit(y ?? x)];
  if (!y) return unit;
  const name = unit.unit === other.unit ? `${unit.unit}²` : `${unit.unit}·${other.unit}`;
  return { unit: name, scale: unit.scale * other.scale };
}

/**
 * Returns the labels of both ends of a colour bar.
 * @param {Shade} shade
 * @param {number} digits
 * @returns {[string, string]}
 */
export function rangeLabels({ low, high, clipped }, digits) {
  if (low === 0) return ['0', '1'];
  const isRatio = low === -high;
  const top = isRatio ? signed(high, digits) : fixed(high, digits);
  return [`${clipped ? '≤' : ''}${fixed(low, digits)}`, `${clipped && isRatio ? '≥' : ''}${top}`];
}

/**
 * Returns the number of digits that distinguishes both ends of a colour bar.
 * @param {Shade} shade
 */
export function rangeDigits({ low, high }) {
  const span = high - low;
  if (span < 0.2) return 3;
  return span < 2 ? 2 : span < 8 ? 1 : 0;
}

/**
 * Returns the value of a cell.
 * @param {Maps} maps
 * @param {number} layer
 * @param {number} cell
 * @returns {{log: number, relative: number, clipped: boolean}} relative to the peak; clipped: the value may be lower
 */
export function valueAt(maps, layer, cell) {
  const [value, range] = [maps.cells[layer][cell], maps.log_range[layer]];
  const below = range * (value / CELL_STEPS - 1);
  const clipped = value === 0 && range >= LOG_RANGE;
  return { log: maps.log_max[layer] + below, relative: Math.exp(below), clipped };
}

/**
 * Returns the borders of the smallest regions that contain given shares of the likelihood.
 * @param {Maps} maps
 * @param {number} layer
 * @param {number[]} shares
 * @returns {number[][]} line segments x0, y0, x1, y1 of each region, from 0 to 1 with y up
 */
export function borders(maps, layer, shares) {
  const [cells, span] = [maps.cells[layer], maps.log_range[layer]];
  const sorted = cells.slice().sort();
  const likelihood = Float64Array.from(sorted, (value) =>
    Math.exp(span * (value / CELL_STEPS - 1)),
  );
  const total = likelihood.reduce((a, b) => a + b, 0);
  return shares.map((share) => {
    let [sum, i] = [0, sorted.length];
    while (i > 0 && sum < share * total) sum += likelihood[--i];
    return contour(cells, maps.size, sorted[i] - 0.5);
  });
}

/**
 * Pairs of sides of a square between four cell centres that the contour crosses.
 * Indexed by the bits of the corners inside: 1, 2, 4, 8, counterclockwise from the lower left.
 */
const CROSSED_SIDES = [
  [],
  [3, 0],
  [0, 1],
  [3, 1],
  [1, 2],
  [3, 0, 1, 2],
  [0, 2],
  [3, 2],
  [2, 3],
  [2, 0],
  [0, 1, 2, 3],
  [2, 1],
  [1, 3],
  [1, 0],
  [0, 3],
  [],
];

/**
 * Finds a contour by marching squares.
 * @param {Uint16Array} cells
 * @param {number} size
 * @param {number} level
 */
function contour(cells, size, level) {
  /** @param {number} from @param {number} to */
  const crossing = (from, to) => 0.5 + (level - from) / (to - from);
  /** @param {number} value @param {number} bit */
  const inside = (value, bit) => (value > level ? bit : 0);
  const segments = [];
  for (let row = 0; row < size - 1; row++) {
    for (let column = 0; column < size - 1; column++) {
      const i = row * size + column;
      const [a, b, c, d] = [cells[i], cells[i + 1], cells[i + size + 1], cells[i + size]];
      const corners = inside(a, 1) | inside(b, 2) | inside(c, 4) | inside(d, 8);
      for (const side of CROSSED_SIDES[corners]) {
        const [x, y] = [
          [crossing(a, b), 0.5],
          [1.5, crossing(b, c)],
          [crossing(d, c), 1.5],
          [0.5, crossing(a, d)],
        ][side];
        segments.push((column + x) / size, (row + y) / size);
      }
    }
  }
  return segments;
}
