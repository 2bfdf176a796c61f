/** Texts about likelihood maps: their measures, and the values at the crosshair. */

/** @import { Maps } from './map_values.js' */

import { displayUnit, fixed, percent, signed } from '../core/units.js';
import { areaUnit, cellAt, valueAt } from './map_values.js';

export const QUANTITY_NAMES = { likelihood: 'Likelihood', posterior: 'Posterior' };

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
 * Returns the measures of a layer as lines below its map, and as one description.
 * @param {Maps} maps
 * @param {number} layer
 * @param {boolean} world whether the axes show world coordinates
 */
export function layerMeasures(maps, layer, world) {
  const { log_max: logMax, numbers } = maps;
  const { unit, scale } = areaUnit(maps.axes);
  const peak = positionText(maps, maps.peak[layer], world);
  const [area50, area95] = [numbers.area50[layer], numbers.area95[layer]].map((area) =>
    short(scale * area),
  );
  const entropy = fixed(numbers.entropy[layer] + Math.log(scale), 2); // of a density per unit of area
  const shape = shapeText(maps, layer);
  return {
    lines: [
      `peak ${peak}`,
      `50 % ${area50}, 95 % ${area95} ${unit}`,
      [shape.short, `entropy ${entropy}`].filter(Boolean).join(' · '),
    ],
    description:
      `peak at ${peak}, ln ${maps.quantity} ${fixed(logMax[layer], 2)} at the peak and ${fixed(numbers.truth[layer], 2)} relative to it at the truth; ` +
      `50 % of the ${maps.quantity} within ${area50} ${unit}, 95 % within ${area95} ${unit}; entropy ${entropy} nats (density per ${unit})` +
      shape.long,
  };
}

/**
 * Describes the shape of a layer, in short and in full.
 * @param {Maps} maps
 * @param {number} layer
 */
function shapeText({ numbers, shape: shapes, axes }, layer) {
  const [deviation, axis, shape] = [numbers.deviation[layer], numbers.axis[layer], shapes[layer]];
  if (shape === null) return { short: '', long: '' };
  const ratio = `; length-to-width ratio ${fixed(numbers.elongation[layer], 1)}; `;
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
  if (shape !== 'ridge') return { short: shape, long: `${ratio}shape: ${shape}` };
  if (deviation === null) {
    const text = `ridge at ${fixed(degrees(axis), 0)}°`;
    return { short: text, long: `${ratio}${text} from the x axis` };
  }
  const off = fixed(degrees(deviation), 0);
  return {
    short: `ridge, ${off}° off`,
    long: `${ratio}ridge, ${off}° off the direction that the task expects`,
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
 * Returns the values at the crosshair as lines below a map.
 * @param {Maps} maps
 * @param {number} layer
 * @param {number[]} offset
 * @param {Float32Array | null} ratios log-likelihood ratios, if the maps show them
 */
export function valuesAt(maps, layer, offset, ratios) {
  const cell = cellAt(maps, offset);
  const { log, relative, clipped } = valueAt(maps, layer, cell);
  const lines = [`${fixed(relative, 3)} of peak, ln ${clipped ? '< ' : ''}${fixed(log, 2)}`];
  if (ratios) lines.push(`gain ${signed(ratios[cell], 2)} nats`);
  return lines;
}
