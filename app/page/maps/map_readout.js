/** The values of a map at the crosshair, in a box beside the pointer. */

import { create, html } from '../core/dom.js';

const GAP = 12; // px between the crosshair and the box

export class MapReadout {
  #box;

  /** @param {HTMLElement} box */
  constructor(box) {
    this.#box = box;
  }

  /**
   * Shows a position and the values of the map there.
   * @param {string} position
   * @param {string[]} values
   * @param {{x: number, y: number}} point of the crosshair, px in the window
   */
  show(position, values, { x, y }) {
    html('#maps-value', this.#box).textContent = position;
    const lines = values.map((textContent) => create('p', { textContent }));
    html('div', this.#box).replaceChildren(...lines);
    this.#box.hidden = false;
    const { offsetWidth: width, offsetHeight: height } = this.#box;
    const right = x + GAP + width <= innerWidth;
    this.#box.style.left = `${right ? x + GAP : Math.max(0, x - GAP - width)}px`;
    this.#box.style.top = `${Math.min(y + GAP, innerHeight - height)}px`;
  }

  hide() {
    this.#box.hidden = true;
    html('#maps-value', this.#box).textContent = '';
  }
}
