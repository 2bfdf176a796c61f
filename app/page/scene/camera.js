/** The picture as the filter sees it at a step: small and gray, enlarged; a black-out is named. */

export class Camera {
  #figure;
  #pen;
  #trace = null;

  /** @param {HTMLElement} figure */
  constructor(figure) {
    this.#figure = figure;
    this.#pen = figure.querySelector('canvas').getContext('2d', { willReadFrequently: true }); // drawn by the processor: no waiting for the scene's
  }

  /** @param {import('../data/trace.js').Trace} trace */
  show(trace) {
    this.#trace = trace;
    this.#figure.hidden = !trace.pictures;
    if (!trace.pictures) return;
    const [height, width] = trace.header.pictures;
    Object.assign(this.#pen.canvas, { height, width });
    this.#figure.querySelector('figcaption').textContent = `camera, ${width} × ${height}`;
  }

  move(step) {
    const picture = this.#trace?.picture(step);
    if (!picture) return;
    const { width, height } = this.#pen.canvas;
    const image = new ImageData(width, height);
    new Uint32Array(image.data.buffer).set(Uint32Array.from(picture, (gray) => 0xff000000 | (gray * 0x010101)));
    this.#pen.putImageData(image, 0, 0);
    this.#figure.querySelector('.black-out').hidden = !this.#trace.black[step];
  }
}
