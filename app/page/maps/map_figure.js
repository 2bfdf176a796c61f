/** The figure of a likelihood map: title, colour bar, canvas and caption. */

/** @import { ColourMap } from '../core/palette.js' */
/** @import { Shade } from './map_values.js' */

import { create } from '../core/dom.js';
import { cssVariable, gradient } from '../core/palette.js';
import { fixed } from '../core/units.js';
import { rangeDigits, rangeLabels } from './map_values.js';

/**
 * @typedef {object} Figure of a layer
 * @property {string} name
 * @property {HTMLElement} figure
 * @property {HTMLCanvasElement} canvas
 * @property {HTMLElement} head
 * @property {{element: HTMLElement, low: HTMLElement, gradient: HTMLElement, high: HTMLElement}} bar
 * @property {HTMLElement} caption
 * @property {HTMLElement[]} lines
 * @property {HTMLCanvasElement} cells
 * @property {Shade} shade
 * @property {ColourMap} colourMap
 * @property {number[][]} borders
 */

/**
 * Creates the figure of a layer.
 * @param {string} name
 * @param {boolean} fuses whether the filter fuses several modalities
 * @returns {Figure}
 */
export function createFigure(name, fuses) {
  const label = fuses || name !== 'fused' ? name.replaceAll('+', ' + ') : 'estimate';
  const [low, high] = [create('b'), create('b')];
  const colours = create('i');
  const bar = create('span', { className: 'colours' }, low, colours, high);
  const head = create('div', { className: 'head' }, create('h3', { textContent: label }), bar);
  const lines = [create('p'), create('p'), create('p')];
  const caption = create('figcaption', {}, ...lines);
  const canvas = create('canvas', { role: 'img', tabIndex: 0 });
  const figure = create('figure', {}, head, canvas, caption);
  figure.style.setProperty('--line', `var(${cssVariable(fuses ? name : 'fused')})`);
  return {
    name,
    figure,
    canvas,
    head,
    bar: { element: bar, low, gradient: colours, high },
    caption,
    lines,
    cells: create('canvas'),
    shade: { values: new Float32Array(), low: 0, high: 1, clipped: false },
    colourMap: 'viridis',
    borders: [],
  };
}

/**
 * Shows the colours of a figure and their range.
 * @param {Figure} figure
 * @param {string} title of the quantity
 */
export function updateColourBar({ bar, shade, colourMap }, title) {
  const digits = rangeDigits(shade);
  const isRatio = shade.low === -shade.high;
  const [low, high] = isRatio ? ['', `±${fixed(shade.high, digits)}`] : rangeLabels(shade, digits);
  [bar.low.textContent, bar.high.textContent] = [low, high];
  bar.gradient.style.background = gradient(colourMap);
  const [from, to] = rangeLabels(shade, 2);
  bar.element.title = `Colour: ${title}, from ${from} to ${to}`;
}
