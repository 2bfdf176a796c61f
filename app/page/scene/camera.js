/** The image of a sensor at a step, as the filter receives it: grey, RGB, or an array of numbers in colours. */

/** @import { Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */

import { context2d, create, element, html } from '../core/dom.js';
import { COLOUR_TABLES } from '../core/palette.js';
import { displayName, significant } from '../core/units.js';
import { sensorImages } from '../data/api.js';
import { imageAt } from '../data/trace.js';

export class Camera {
  #figure;
  #context;
  #store;
  /** @type {Trace | null} */
  #trace = null;
  /** Images of other sensors than the first one, by name. @type {Map<string, Uint8Array>} */
  #images = new Map();

  /**
   * @param {HTMLElement} figure
   * @param {Store} store
   */
  constructor(figure, store) {
    this.#figure = figure;
    this.#store = store;
    // Drawn by the processor, so that it does not wait for the 3D scene.
    this.#context = context2d(element('canvas', HTMLCanvasElement, figure), {
      willReadFrequently: true,
    });
    store.listen((_, changed) => {
      if (changed.has('sensor') && this.#trace) this.show(this.#trace);
    });
  }

  /** @param {Trace} trace */
  show(trace) {
    if (trace !== this.#trace) this.#images.clear();
    this.#trace = trace;
    this.#figure.hidden = !trace.images;
    const sensor = this.#sensor;
    if (!sensor) return;
    const { name, height, width, low, high } = sensor;
    Object.assign(this.#context.canvas, { height, width });
    html('div', this.#figure).style.aspectRatio = `${width} / ${height}`;
    const range = low === null ? '' : `, ${significant(low)} to ${significant(high)}`;
    html('figcaption', this.#figure).replaceChildren(
      this.#picker(name),
      `${width} × ${height}${range}`,
    );
    this.move(this.#store.state.step);
    if (name !== trace.header.sensors[0].name && !this.#images.has(name)) this.#load(trace, name);
  }

  /** @param {number} step */
  move(step) {
    const [trace, sensor] = [this.#trace, this.#sensor];
    if (!trace || !sensor) return;
    const images = this.#images.get(sensor.name);
    const isFirst = sensor === trace.header.sensors[0];
    const pixels = isFirst ? trace.image(step) : images && imageAt(images, sensor, step);
    if (!pixels?.length) return;
    const { width, height } = this.#context.canvas;
    const image = new ImageData(width, height);
    new Uint32Array(image.data.buffer).set(colours(pixels, sensor));
    this.#context.putImageData(image, 0, 0);
    const isBlack = isFirst && trace.blackout[step];
    html('.blackout', this.#figure).hidden = !isBlack;
  }

  get #sensor() {
    const sensors = this.#trace?.header.sensors ?? [];
    return sensors.find(({ name }) => name === this.#store.state.sensor) ?? sensors[0];
  }

  /**
   * Returns the name of the sensor, or a menu of all sensors.
   * @param {string} name
   */
  #picker(name) {
    const sensors = this.#trace?.header.sensors ?? [];
    if (sensors.length < 2)
      return create('span', {
        textContent: name === 'image' ? 'camera, ' : `${displayName(name)}, `,
      });
    const options = sensors.map((sensor) => new Option(displayName(sensor.name), sensor.name));
    const select = create('select', { ariaLabel: 'Sensor' }, ...options);
    select.value = name;
    select.addEventListener('change', () => this.#store.set({ sensor: select.value }));
    return select;
  }

  /**
   * @param {Trace} trace
   * @param {string} name
   */
  async #load(trace, name) {
    const buffer = await sensorImages(trace.selection, name);
    if (trace !== this.#trace) return;
    this.#images.set(name, new Uint8Array(buffer));
    this.move(this.#store.state.step);
  }
}

/**
 * Returns the colours of pixels, with the bytes R, G, B, A in memory.
 * @param {Uint8Array} pixels
 * @param {{channels: number, low: number | null}} sensor
 */
function colours(pixels, { channels, low }) {
  if (channels === 1)
    return Uint32Array.from(pixels, (value) =>
      low === null ? 0xff000000 | (value * 0x010101) : COLOUR_TABLES.viridis[value],
    );
  return Uint32Array.from(
    { length: pixels.length / 3 },
    (_, i) => 0xff000000 | (pixels[3 * i + 2] << 16) | (pixels[3 * i + 1] << 8) | pixels[3 * i],
  );
}
