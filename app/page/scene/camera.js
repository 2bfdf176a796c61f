/**
 * A sensor at a step, as the filter receives it: an image, an array of numbers in colours, or the points of a scan or
 * point cloud from above.
 */

/** @import { Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */

import { context2d, create, element, html, paintPixels, setOptions } from '../core/dom.js';
import { COLOUR_TABLES, colour } from '../core/colours.js';
import { displayName, niceStep, significant } from '../core/units.js';
import { sensorImages } from '../data/api.js';
import { imageAt } from '../data/trace.js';

const TOP_VIEW = 480; // px, side of the view of points from above

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
    store.when(['sensor'], () => this.#trace && this.show(this.#trace));
  }

  /** @param {Trace} trace */
  show(trace) {
    if (trace !== this.#trace) this.#images.clear();
    this.#trace = trace;
    this.#figure.hidden = !trace.images;
    const sensor = this.#sensor;
    if (!sensor) return;
    const { name, points } = sensor;
    const [width, height] = points ? [TOP_VIEW, TOP_VIEW] : [sensor.width, sensor.height];
    Object.assign(this.#context.canvas, { height, width });
    this.#context.canvas.style.imageRendering = points ? 'auto' : '';
    html('div', this.#figure).style.aspectRatio = `${width} / ${height}`;
    html('figcaption', this.#figure).replaceChildren(this.#picker(name), description(sensor));
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
    if (sensor.points) {
      drawPoints(this.#context, pixels, sensor.high ?? 1);
      return;
    }
    paintPixels(this.#context.canvas, colours(pixels, sensor), this.#context);
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
    const select = create('select', { ariaLabel: 'Sensor' });
    const options = sensors.map((sensor) => [sensor.name, displayName(sensor.name)]);
    setOptions(select, options, name);
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
 * Returns the size of the images, or the number of points and the distance of the rings.
 * @param {import('../types/server.js').DisplayedSensor} sensor
 */
function description({ width, height, low, high, points }) {
  if (points) return `${points} points, rings ${significant(ringStep(high ?? 1))} m, x up`;
  return `${width} × ${height}${low === null ? '' : `, ${significant(low)} to ${significant(high)}`}`;
}

/** Returns the distance of the rings around a sensor, at most three. @param {number} extent m */
const ringStep = (extent) => niceStep(extent / 3.5);

/**
 * Draws points from above, around the sensor: x up, y to the left.
 * @param {CanvasRenderingContext2D} context
 * @param {Uint8Array} bytes x and y as float32
 * @param {number} extent m, half the side of the view
 */
function drawPoints(context, bytes, extent) {
  const { width } = context.canvas;
  const [middle, scale] = [width / 2, width / 2 / extent];
  const values = new Float32Array(bytes.slice().buffer);
  context.clearRect(0, 0, width, width);
  context.strokeStyle = colour('muted');
  context.lineWidth = 1;
  const step = ringStep(extent);
  for (let radius = step; radius < extent; radius += step) {
    context.beginPath();
    context.arc(middle, middle, radius * scale, 0, 2 * Math.PI);
    context.stroke();
  }
  context.fillStyle = colour('ink');
  const size = values.length > 1000 ? 4 : 6;
  for (let i = 0; i < values.length; i += 2)
    if (Number.isFinite(values[i]))
      context.fillRect(
        middle - values[i + 1] * scale - size / 2,
        middle - values[i] * scale - size / 2,
        size,
        size,
      );
  context.beginPath(); // the sensor, which faces up
  context.moveTo(middle, middle - 10);
  context.lineTo(middle - 6, middle + 6);
  context.lineTo(middle + 6, middle + 6);
  context.fillStyle = colour('accent');
  context.fill();
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
