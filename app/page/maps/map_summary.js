/** Texts about likelihood maps: measures, colours, and the values at the crosshair. */

/** @import { Task } from '../types/server.js' */
/** @import { Maps, Range, Scale, Shade } from './map_values.js' */
/** @import { Reference } from './reference_maps.js' */

import { displayName, displayUnit, fixed, mainName, percent, signed } from '../core/units.js';
import { areaUnit, cellAt, offsetOffMap, rangeDigits, rangeLabels, valueAt } from './map_values.js';

export const QUANTITY_NAMES = { likelihood: 'Likelihood', posterior: 'Posterior' };

const OFF_MAP = 'estimate off the map';

/** @param {number | null} radians */
const degrees = (radians) => (radians === null ? null : (radians * 180) / Math.PI);

/**
 * Formats an area or a divergence.
 * @param {number | null} value
 */
const short = (value) => fixed(value, value !== null && value < 10 ? 1 : 0);

/**
 * Formats an offset from the truth, in the coordinates and units of the axes.
 * @param {Maps} maps
 * @param {number[]} offset
 * @param {boolean} world
 */
export function positionText({ axes, centre }, offset, world) {
  const units = axes.map(displayUnit);
  const texts = units.map(({ scale }, i) => {
    const d = offset[i];
    return world ? fixed(scale * (d + centre[i])) : signed(scale * d);
  });
  if (units.every(({ unit }) => unit === units[0].unit))
    return `${texts.join(', ')} ${units[0].unit}`.trim();
  return texts.map((text, i) => `${text} ${units[i].unit}`.trim()).join(', ');
}

/**
 * Returns the quantity of the maps and the rule of the fused one.
 * @param {Maps} maps
 */
export const mapTitle = ({ quantity, layers, rule, note }) =>
  QUANTITY_NAMES[quantity] + (note && `, ${note}`) + (layers.length > 2 ? `. Fused: ${rule}` : '');

/**
 * Names the state components of the axes.
 * @param {Maps} maps
 * @param {Task} [task]
 */
export function axesSubject({ axes }, task) {
  const names = axes.map(({ name }) => name);
  const isPosition = task?.main.name === 'position' && names.join() === task.map.components.join();
  return isPosition ? mainName(task) : names.map(displayName).join(', ');
}

/**
 * Describes what the colours show.
 * @param {Maps['quantity']} quantity
 * @param {string} scale
 * @param {string} range
 * @param {Reference | null} reference
 */
export function colourTitle(quantity, scale, range, reference) {
  if (reference) {
    const { selection, name } = reference;
    const run = selection
      ? `${name} (${selection.filter}, episode ${selection.episode})`
      : `the comparison run (${name})`;
    return `log of the ${quantity} relative to ${run}, both as densities over the displayed area`;
  }
  if (scale === 'log') return `log ${quantity}`;
  return `${quantity} relative to ${range === 'same' ? 'the highest' : 'its own'} peak`;
}

/**
 * Returns the measures of a layer as cells of a table (`measureColumns`), and as one description.
 * @param {Maps} maps
 * @param {number} layer
 * @param {boolean} world whether the axes show world coordinates
 */
export function layerMeasures(maps, layer, world) {
  const off = posteriorOffMap(maps, layer);
  if (off) {
    const short = `${OFF_MAP}, at ${positionText(maps, off, world)}`;
    return { cells: ['–', '–', '–', '–', short], description: short };
  }
  const { log_max: logMax, numbers } = maps;
  const { unit, scale } = areaUnit(maps.axes);
  const peak = positionText(maps, maps.peak[layer], world);
  const [area50, area95] = [numbers.area50[layer], numbers.area95[layer]].map((area) =>
    short(scale * area),
  );
  const entropy = fixed(numbers.entropy[layer] + Math.log(scale), 2); // of a density per unit of area
  const shape = shapeText(maps, layer);
  return {
    cells: [peak, area50, area95, entropy, shape.short],
    description:
      `peak at ${peak}, ln ${maps.quantity} ${fixed(logMax[layer], 2)} at the peak and ${fixed(numbers.truth[layer], 2)} relative to it at the truth; ` +
      `50 % of the ${maps.quantity} within ${area50} ${unit}, 95 % within ${area95} ${unit}; entropy ${entropy} nats (density per ${unit})` +
      shape.long,
  };
}

/**
 * Names the columns of the measures, with their units.
 * @param {Maps} maps
 */
export function measureColumns({ axes }) {
  const { unit } = areaUnit(axes);
  return ['peak', `50 % (${unit})`, `95 % (${unit})`, 'entropy (nats)', 'shape'];
}

/**
 * Names the axes of the maps, with their units.
 * @param {Maps} maps
 * @param {boolean} world whether they show world coordinates
 * @param {string} [height] label of the colour scale, which a map over one component shows as its height
 */
export function axesText({ axes }, world, height = '') {
  const units = axes.map((axis) => displayUnit(axis).unit);
  const common = units.every((unit) => unit === units[0]);
  const texts = axes.map(({ name }, i) => {
    const short = displayName(name);
    const label = world ? short : `Δ${short.length > 1 ? ' ' : ''}${short}`;
    const unit = units[i] && (!common || i === axes.length - 1) ? ` (${units[i]})` : '';
    return `${i ? '↑' : '→'} ${label}${unit}`;
  });
  if (height) texts.push(`↑ ${height.replace(/^of /, 'fraction of ').replace(/;.*/, '')}`);
  return texts.join('  ');
}

/** @typedef {{low: string, high: string, label: string}} ColourScale labels of the ends of the colour bar, and of all of it */

/**
 * Returns the labels of the colour bar of all maps.
 * @param {Maps['quantity']} quantity
 * @param {Scale} scale
 * @param {Range} range
 * @param {{name: string, shade: Shade, peak: number}[]} layers peak: log-likelihood
 * @param {string} reference name of the maps that ratios are relative to; empty for likelihoods
 * @returns {ColourScale}
 */
export function colourScale(quantity, scale, range, layers, reference) {
  const log = scale === 'log' && !reference;
  const own = range !== 'same';
  if (!reference && !log) {
    const peak = own ? 'each peak' : 'the highest peak';
    return { low: '0', high: '1', label: `of ${peak}` };
  }
  const ends = layers.map(({ shade, peak }) => {
    const limits = log && own ? { ...shade, low: shade.low - peak, high: 0 } : shade;
    const [low, high] = rangeLabels(limits, rangeDigits(shade));
    return { low, high };
  });
  const common = ends.every(({ low, high }) => low === ends[0].low && high === ends[0].high);
  const what = log
    ? `log ${quantity}${own ? ' below each peak' : ''}, nats`
    : `log density ratio to ${reference}, nats`;
  if (common) return { ...ends[0], label: what };
  const scales = ends.map(({ low, high }, i) => `${layers[i].name} ${log ? low : high}`);
  return { low: '', high: log ? '0' : '', label: `${what}; ends: ${scales.join(', ')}` };
}

/**
 * Names the shape of a layer that is drawn on its map, and its size.
 * @param {Maps} maps
 * @param {number} layer
 */
export const shapeName = (maps, layer) =>
  posteriorOffMap(maps, layer) ? [OFF_MAP] : shapeText(maps, layer).short.split(', ').slice(0, 2);

/**
 * Returns the offset of the estimate if the layer is its posterior and it is off the map: the measures of the map are
 * then those of an edge. Null otherwise.
 * @param {Maps} maps
 * @param {number} layer
 */
const posteriorOffMap = (maps, layer) =>
  maps.quantity === 'posterior' && maps.layers[layer] === 'fused' ? offsetOffMap(maps) : null;

/**
 * Returns the labels of the colour bar of small maps of several steps, whose colours have the same ends.
 * @param {Maps['quantity']} quantity
 * @param {string} scale
 * @param {string} range
 * @param {Shade} shade of any of them
 * @returns {ColourScale}
 */
export function tilesScale(quantity, scale, range, shade) {
  const [low, high] = rangeLabels(shade, 0);
  const peak = range === 'same' ? "the step's highest peak" : 'each peak';
  const log = scale === 'log';
  const label = log ? `log ${quantity} below ${peak}, nats` : `of ${peak}`;
  return { low, high, label };
}

/**
 * Describes the shape of a layer, in short and in full.
 * @param {Maps} maps
 * @param {number} layer
 */
function shapeText({ numbers, shape: shapes, axes, quantity }, layer) {
  const [deviation, axis, shape] = [numbers.deviation[layer], numbers.axis[layer], shapes[layer]];
  if (shape === null) return { short: '', long: '' };
  const elongation = fixed(numbers.elongation[layer], 1);
  const ratio = `; length-to-width ratio ${elongation}; `;
  if (shape === 'ring') {
    const { unit, scale } = displayUnit(axes[0]);
    const radius = `${fixed(scale * (numbers.ring_radius[layer] ?? NaN))} ${unit}`;
    const [x, y] = numbers.ring_centre[layer].map((m) => signed(scale * (m ?? NaN)));
    const part = percent(numbers.ring_coverage[layer]);
    return {
      short: `ring, radius ${radius}`,
      long: `${ratio}ring with radius ${radius} around ${x}, ${y} ${unit} from the truth, over ${part} of the circle`,
    };
  }
  if (shape === 'flat')
    return { short: shape, long: `; flat: the ${quantity} hardly varies over the map` };
  if (shape !== 'ridge') return { short: shape, long: `${ratio}shape: ${shape}` };
  const angle = Math.round(degrees(axis) ?? NaN);
  const direction = `ridge ${fixed(angle > -90 ? angle : angle + 180, 0)}°`;
  const off = deviation === null ? '' : `, ${fixed(degrees(deviation), 0)}° off`;
  return {
    short: `${direction}, ${elongation}:1${off && `${off} expected`}`,
    long: `${ratio}${direction} from the x axis${off && `${off} the direction that the task expects`}`,
  };
}

/**
 * Returns the differences between the modalities, pair by pair.
 * @param {Maps} maps
 */
export function pairwiseMeasures({ layers, numbers }) {
  const modalities = layers.slice(0, -1);
  const pairs = modalities.flatMap((a, i) =>
    modalities.slice(i + 1).map((b, offset) => {
      const j = i + 1 + offset;
      const [forward, backward] = [numbers.divergence[i][j], numbers.divergence[j][i]].map(short);
      return `KL(${a}‖${b}) ${forward}, KL(${b}‖${a}) ${backward} nats, overlap ${percent(numbers.overlap[i][j])}`;
    }),
  );
  return pairs.join(' · ');
}

/**
 * Returns the values of a layer at the crosshair.
 * @param {Maps} maps
 * @param {number} layer
 * @param {number[]} offset
 * @param {Float32Array | null} ratios log-likelihood ratios, if the maps show them
 */
export function valuesAt(maps, layer, offset, ratios) {
  const cell = cellAt(maps, offset);
  const { log, relative, clipped } = valueAt(maps, layer, cell);
  const values = [`${fixed(relative, 3)} of peak`, `ln ${clipped ? '< ' : ''}${fixed(log, 2)}`];
  if (ratios) values.push(`change ${signed(ratios[cell], 2)} nats`);
  return values;
}
