/** The figure of a likelihood map, with its title, shape and canvas, and the colour bar of all maps. */

/** @import { ColourMap } from '../core/colours.js' */
/** @import { ColourScale } from './map_summary.js' */
/** @import { Shade } from './map_values.js' */

import { create, html } from '../core/dom.js';
import { cssVariable, gradient } from '../core/colours.js';
import { displayName } from '../core/units.js';

/**
 * @typedef {object} Figure of a layer
 * @property {string} name
 * @property {HTMLElement} figure
 * @property {HTMLCanvasElement} canvas
 * @property {HTMLElement} head
 * @property {HTMLElement} shape the name and size of the ridge or ring on the map
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
  const label = fuses || name !== 'fused' ? displayName(name).replaceAll('+', ' + ') : 'estimate';
  const shape = create('span', { className: 'shape' });
  const head = create('div', { className: 'head' }, create('h3', { textContent: label }), shape);
  const canvas = create('canvas', { role: 'img', tabIndex: 0 });
  const figure = create('figure', {}, head, canvas);
  figure.style.setProperty('--line', `var(${cssVariable(fuses ? name : 'fused')})`);
  return {
    name,
    figure,
    canvas,
    head,
    shape,
    cells: create('canvas'),
    shade: { values: new Float32Array(), low: 0, high: 1, clipped: false },
    colourMap: 'viridis',
    borders: [],
  };
}

/**
 * Shows the name of a shape and, where there is room, its size.
 * @param {Figure} figure
 * @param {string[]} parts
 */
export function showShape({ shape }, parts) {
  if (shape.dataset.text === parts.join()) return;
  shape.dataset.text = parts.join();
  shape.replaceChildren(
    ...parts.map((part, i) => create('span', { textContent: i ? `, ${part}` : part })),
  );
}

/**
 * Shows the colours of all maps, their range, and the quantity with its unit.
 * @param {HTMLElement} host
 * @param {ColourMap} colourMap
 * @param {ColourScale} scale
 */
export function showColourBar(host, colourMap, { low, high, label }) {
  const [from, to] = host.querySelectorAll('b');
  [from.textContent, to.textContent] = [low, high];
  html('i', host).style.background = gradient(colourMap);
  const text = html('span', host);
  text.textContent = text.title = label;
}
