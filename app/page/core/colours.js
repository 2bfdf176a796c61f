/** Colours, dashes and colour maps. The colours of lines are defined in page.css, for light and dark. */

import { svgElement } from './dom.js';

/** @typedef {'viridis' | 'cividis' | 'diverging'} ColourMap */

/**
 * Colours at even places from 0 to 1: matplotlib's viridis and cividis, and ColorBrewer's RdBu.
 * @type {Record<ColourMap, number[]>}
 */
const STOPS = {
  viridis: [
    0x440154, 0x481a6c, 0x472f7d, 0x414487, 0x39568c, 0x31688e, 0x2a788e, 0x23888e, 0x1f988b,
    0x22a884, 0x35b779, 0x54c568, 0x7ad151, 0xa5db36, 0xd2e21b, 0xfde725,
  ],
  cividis: [
    0x00224e, 0x002e6c, 0x1e3a6f, 0x35456c, 0x47516c, 0x575d6d, 0x666970, 0x757575, 0x848279,
    0x948e77, 0xa59c74, 0xb7a96e, 0xc8b866, 0xdbc75a, 0xeed649, 0xfee838,
  ],
  diverging: [
    0x053061, 0x2166ac, 0x4393c3, 0x92c5de, 0xd1e5f0, 0xf7f7f7, 0xfddbc7, 0xf4a582, 0xd6604d,
    0xb2182b, 0x67001f,
  ],
};

/** Each source has its own colour and dash, so that lines differ without colour too. @type {Record<string, number[]>} */
const DASHES = { truth: [], fused: [], image: [7, 3], haptics: [2, 2.5] };
/** @type {Record<string, number>} */
const WIDTHS = { truth: 1.25, fused: 2.25 };
/** Suffix of the estimate of a standalone filter, which has the colour of its modality. */
const STANDALONE = / standalone$/;
const SPARE_DASHES = [
  [9, 3, 2, 3],
  [4, 2],
  [1, 3],
  [12, 3],
  [6, 2, 1, 2, 1, 2],
  [3, 5],
  [10, 2, 4, 2],
  [2, 1],
];
const SPARE_VARIABLES = SPARE_DASHES.map((_, i) => `--spare-${i}`);

/** Colours of the channels of sensors, which are no modalities. */
const CHANNEL_VARIABLES = [7, 2, 3, 5, 4, 6, 0, 1].map((i) => SPARE_VARIABLES[i]);

const UNIT =
  typeof document === 'undefined'
    ? 1
    : parseFloat(getComputedStyle(document.documentElement).fontSize) / 10;

/**
 * Scales a length as `rem` does in the style sheets, where 1 rem is 10 px on most screens.
 * @param {number} px
 */
export const scaled = (px) => Math.round(px * UNIT);

/**
 * Interpolates 256 colours, with the bytes R, G, B, A in memory as in ImageData.
 * @param {number[]} stops
 */
function colourTable(stops) {
  const bytes = new Uint8ClampedArray(256 * 4);
  for (let i = 0; i < 256; i++) {
    const position = (i / 255) * (stops.length - 1);
    const low = Math.min(Math.floor(position), stops.length - 2);
    for (let channel = 0; channel < 3; channel++) {
      const shift = 16 - 8 * channel;
      const [a, b] = [(stops[low] >> shift) & 255, (stops[low + 1] >> shift) & 255];
      bytes[4 * i + channel] = a + (b - a) * (position - low);
    }
    bytes[4 * i + 3] = 255;
  }
  return new Uint32Array(bytes.buffer);
}

export const COLOUR_TABLES = /** @type {Record<ColourMap, Uint32Array>} */ (
  Object.fromEntries(Object.entries(STOPS).map(([name, stops]) => [name, colourTable(stops)]))
);

/**
 * Returns a colour map as a CSS gradient from left to right.
 * @param {ColourMap} name
 */
export const gradient = (name) =>
  `linear-gradient(90deg, ${STOPS[name].map((stop) => `#${stop.toString(16).padStart(6, '0')}`).join(', ')})`;

/**
 * Returns the current value of a colour of page.css, light or dark.
 * @param {string} name without the leading dashes
 */
export const colour = (name) =>
  getComputedStyle(document.documentElement).getPropertyValue(`--${name}`);

/** Modalities without a colour of their own. @type {string[]} */
let unnamed = [];
/** CSS variables of their colours. */
let spareColours = SPARE_VARIABLES;

/**
 * Assigns spare colours and dashes to the modalities that have none of their own. Without a modality `image`, the
 * first of them has its colour.
 * @param {string[]} modalities of the displayed trace
 */
export function assignSpareColours(modalities) {
  unnamed = modalities.filter((name) => !Object.hasOwn(DASHES, name));
  spareColours = modalities.includes('image') ? SPARE_VARIABLES : ['--image', ...SPARE_VARIABLES];
}

/**
 * @template T
 * @param {T[]} list
 * @param {string} name
 */
const spareOf = (list, name) => list[Math.max(0, unnamed.indexOf(name)) % list.length];

/**
 * Returns the CSS variable with the colour of a source.
 * @param {string} name truth, fused or a modality
 */
export const cssVariable = (name) => {
  const source = name.replace(STANDALONE, '');
  return Object.hasOwn(DASHES, source) ? `--${source}` : spareOf(spareColours, source);
};

/**
 * @param {string} colour `rgb(...)`
 * @param {number} alpha 0..1
 */
export const translucent = (colour, alpha) =>
  `color-mix(in srgb, ${colour} ${100 * alpha}%, transparent)`;

/** @typedef {{stroke: string, dash: number[], width: number}} LineStyle */

/**
 * Returns the style of the lines of a source.
 * @param {string} name truth, fused or a modality
 * @returns {LineStyle}
 */
export function lineStyle(name) {
  const source = name.replace(STANDALONE, '');
  const dash = DASHES[source] ?? spareOf(SPARE_DASHES, source);
  return { stroke: colour(cssVariable(name).slice(2)), dash, width: WIDTHS[name] ?? 1.5 };
}

/**
 * Returns the CSS variable with the colour of a channel of a sensor.
 * @param {number} line number of the channel
 */
export const channelVariable = (line) => CHANNEL_VARIABLES[line % CHANNEL_VARIABLES.length];

/**
 * Returns the style of the line of a channel of a sensor. Channels with the same colour differ in their dashes.
 * @param {number} line number of the channel
 * @returns {LineStyle}
 */
export function channelStyle(line) {
  const round = Math.floor(line / CHANNEL_VARIABLES.length);
  const dash = round ? SPARE_DASHES[(round - 1) % SPARE_DASHES.length] : [];
  return { stroke: colour(channelVariable(line).slice(2)), dash, width: 1.5 };
}

/**
 * Creates a short sample of the line of a source, for legends.
 * @param {string} name truth, fused or a modality
 */
export function swatch(name) {
  const { dash, width } = lineStyle(name);
  return lineSample(cssVariable(name), dash, width);
}

/**
 * Creates a short sample of any line.
 * @param {string} property CSS variable of the colour
 * @param {number[]} dash
 * @param {number} width
 */
export function lineSample(property, dash, width) {
  const line = { d: 'M0 4h20', 'stroke-dasharray': dash.join(' '), 'stroke-width': width };
  const path = svgElement('path', { ...line, style: `stroke: var(${property})` });
  return svgElement('svg', { class: 'swatch', viewBox: '0 0 20 8', 'aria-hidden': 'true' }, path);
}
