/** Texts about likelihood maps: their measures, and the values at the crosshair. */

/** @import { Maps } from './map_values.js' */

import { fixed, percent, signed } from '../core/units.js';
import { cellAt, valueAt } from './map_values.js';

export const QUANTITY_NAMES = { likelihood: 'Likelihood', posterior: 'Posterior' };

/** @param {number | null} radians */
const degrees = (radians) => (radians === null ? null : (radians * 180) / Math.PI);

/**
 * Formats an area or a divergence.
 * @param {number | null} value
 */
const short = (value) => fixed(value, value !== null && value < 10 ? 1 : 0);

/**
 * Formats an offset from the truth, in the coordinates of the axes, in cm.
 * @param {Maps} maps
 * @param {number[]} offset m
 * @param {boolean} world
 */
export function positionText(maps, offset, world) {
  const texts = offset.map((d, i) => (world ? fixed(100 * (d + maps.centre[i])) : signed(100 * d)));
  return texts.join(', ');
}

/**
 * Returns the quantity of the maps and the rule of the fused one.
 * @param {Maps} maps
 */
export const mapTitle = ({ quantity, layers, rule }) =>
  QUANTITY_NAMES[quantity] + (layers.length > 2 ? `. Fused: ${rule}` : '');

/**
 * Returns the measures of a layer as lines below its map, and as one description.
 * @param {Maps} maps
 * @param {number} layer
 * @param {boolean} world whether the axes show world coordinates
 */
export function layerMeasures(maps, layer, world) {
  const { log_max: logMax, numbers } = maps;
  const peak = positionText(maps, maps.peak[layer], world);
  const [area50, area95] = [numbers.area50[layer], numbers.area95[layer]].map((m2) =>
    short(1e4 * m2),
  );
  const entropy = fixed(numbers.entropy[layer] + Math.log(1e4), 2); // of a density per cm²
  const shape = shapeText(maps, layer);
  return {
    lines: [
      `peak ${peak} cm`,
      `50 % ${area50}, 95 % ${area95} cm²`,
      `${shape.short} · entropy ${entropy}`,
    ],
    description:
      `peak at ${peak} cm, ln ${maps.quantity} ${fixed(logMax[layer], 2)} at the peak and ${fixed(numbers.truth[layer], 2)} relative to it at the truth; ` +
      `50 % of the ${maps.quantity} within ${area50} cm², 95 % within ${area95} cm²; entropy ${entropy} nats (density per cm²); ` +
      `length-to-width ratio ${fixed(numbers.elongation[layer], 1)}; ${shape.long}`,
  };
}

/**
 * Describes the shape of a layer, in short and in full.
 * @param {Maps} maps
 * @param {number} layer
 */
function shapeText({ numbers, shape }, layer) {
  const [deviation, axis] = [numbers.deviation[layer], numbers.axis[layer]];
  if (shape[layer] === 'ring') {
    const radius = fixed(100 * numbers.ring_radius[layer]);
    const [x, y] = numbers.ring_centre[layer].map((m) => signed(100 * (m ?? NaN)));
    const part = percent(numbers.ring_coverage[layer]);
    return {
      short: `ring, radius ${radius} cm`,
      long: `ring with radius ${radius} cm around ${x}, ${y} cm from the truth, over ${part} of the circle`,
    };
  }
  if (shape[layer] !== 'ridge') return { short: shape[layer], long: `shape: ${shape[layer]}` };
  if (deviation === null) {
    const text = `ridge at ${fixed(degrees(axis), 0)}°`;
    return { short: text, long: `${text} from the x axis` };
  }
  const off = fixed(degrees(deviation), 0);
  return {
    short: `ridge, ${off}° off`,
    long: `ridge, ${off}° off the direction that the task expects`,
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
 * @param {number[]} offset m
 * @param {Float32Array | null} ratios log-likelihood ratios, if the maps show them
 */
export function valuesAt(maps, layer, offset, ratios) {
  const cell = cellAt(maps, offset);
  const { log, relative, clipped } = valueAt(maps, layer, cell);
  const lines = [`${fixed(relative, 3)} of peak, ln ${clipped ? '< ' : ''}${fixed(log, 2)}`];
  if (ratios) lines.push(`gain ${signed(ratios[cell], 2)} nats`);
  return lines;
}
