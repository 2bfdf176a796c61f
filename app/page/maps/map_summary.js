/** Texts about likelihood maps: their measures, and the values at the crosshair. */

/** @import { Maps } from './map_values.js' */

import { fixed, percent, signed } from '../core/units.js';
import { cellAt, valueAt } from './map_values.js';

const MIN_ELONGATION = 1.3; // below this ratio a map has no long axis

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
  const elongated = numbers.elongation[layer] >= MIN_ELONGATION;
  const angle = numbers.off_line[layer];
  const ridge =
    elongated && angle !== null
      ? `; the long axis is ${fixed(degrees(angle), 0)}° from the line between truth and end effector`
      : '';
  return {
    lines: [
      `peak ${peak} cm`,
      `50 % ${area50}, 95 % ${area95} cm²`,
      `${axisText(maps, layer, elongated)} · entropy ${entropy}`,
    ],
    description:
      `peak at ${peak} cm, log-likelihood ${fixed(logMax[layer], 2)} at the peak and ${fixed(numbers.truth[layer], 2)} relative to it at the truth; ` +
      `50 % of the likelihood within ${area50} cm², 95 % within ${area95} cm²; entropy ${entropy} nats (density per cm²); ` +
      `length-to-width ratio ${fixed(numbers.elongation[layer], 1)}${ridge}`,
  };
}

/**
 * @param {Maps} maps
 * @param {number} layer
 * @param {boolean} elongated
 */
function axisText({ numbers }, layer, elongated) {
  const angle = numbers.off_line[layer];
  if (!elongated) return 'no ridge';
  return angle === null
    ? `axis ${fixed(degrees(numbers.axis[layer]), 0)}°`
    : `ridge at ${fixed(degrees(angle), 0)}°`;
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
