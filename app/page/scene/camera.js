/** The camera image of a step, at the filter's resolution. */

/** @import { Trace } from '../data/trace.js' */

import { context2d, create, element, html } from '../core/dom.js';

export class Camera {
  #figure;
  #context;
  /** @type {Trace | null} */
  #trace = null;

  /** @param {HTMLElement} figure */
  constructor(figure) {
    this.#figure = figure;
    // Drawn by the processor, so that it does not wait for the 3D scene.
    this.#context = context2d(element('canvas', HTMLCanvasElement, figure), {
      willReadFrequently: true,
    });
  }

  /** @param {Trace} trace */
  show(trace) {
    this.#trace = trace;
    this.#figure.hidden = !trace.images;
    if (!trace.header.image_size) return;
    const [height, width] = trace.header.image_size;
    Object.assign(this.#context.canvas, { height, width });
    html('figcaption', this.#figure).replaceChildren(
      create('span', { textContent: 'camera, ' }),
      `${width} × ${height}`,
    );
  }

  /** @param {number} step */
  move(step) {
    const gray = this.#trace?.image(step);
    if (!gray) return;
    const { width, height } = this.#context.canvas;
    const image = new ImageData(width, height);
    new Uint32Array(image.data.buffer).set(
      Uint32Array.from(gray, (value) => 0xff000000 | (value * 0x010101)),
    );
    this.#context.putImageData(image, 0, 0);
    html('.blackout', this.#figure).hidden = !this.#trace?.blackout[step];
  }
}
