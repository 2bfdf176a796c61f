/** A trace's numbers as the page shows them: columns over time, in cm and degrees. */

import { SHOWN, wrapped } from './units.js';

const FUSED = 'fused';

export class Trace {
  #columns = new Map();
  #cache = new Map();

  /**
   * @param {import('./api.js').Task} task @param {import('./api.js').Selection} selection
   * @param {object} header as the server sent it @param {ArrayBuffer} buffer its columns, end to end
   * @param {ArrayBuffer | null} pictures T x H x W bytes
   */
  constructor(task, selection, header, buffer, pictures) {
    [this.task, this.selection, this.header] = [task, selection, header];
    this.steps = header.steps;
    this.dt = header.dt;
    this.components = header.components;
    this.modalities = header.modalities;
    /** Whose estimates there are: each modality alone where it is known, and all of them; one alone is the same as all. */
    this.sources = this.fuses && header.columns.some((c) => c.name === 'modality_mean') ? [...header.modalities, FUSED] : [FUSED];
    this.pictures = pictures && new Uint8Array(pictures);
    for (const { name, shape, offset } of header.columns) {
      const size = shape.reduce((a, b) => a * b, 1);
      this.#columns.set(name, { data: new Float32Array(buffer, offset, size), shape });
    }
    const index = (name) => this.components.findIndex((c) => c.name === name);
    /** Positions in the state of the two components that span the maps. */
    this.position = [index(task.map.x), index(task.map.y)];
    this.angles = this.components.map((c, i) => (c.unit === 'rad' ? i : -1)).filter((i) => i >= 0);
    this.contact = this.#slice('contact') ?? new Float32Array(this.steps);
    this.black = this.#blackPictures();
  }

  /** Whether several modalities are fused, or one measurement model, or none, decides alone. */
  get fuses() {
    return this.modalities.length > 1;
  }

  /** What a source is called. */
  called(source) {
    return source === FUSED && !this.fuses ? 'estimate' : source;
  }

  /** Whether another trace is of the same episode, step by step; filter and recipe may differ. */
  alongside({ selection, steps }) {
    return steps === this.steps && ['task', 'data', 'episode'].every((key) => selection[key] === this.selection[key]);
  }

  /** First and last step of each edit of the run. @returns {[number, number][]} */
  get edited() {
    return (this.header.settings?.edits ?? []).map(({ from, to }) => [from, to - 1]);
  }

  has(column) {
    return this.#columns.has(column);
  }

  /** The number of weights a modality has: one, or one for each component. */
  get weightWidth() {
    return (this.#columns.get('weights') ?? this.#columns.get('acting'))?.shape[2] ?? 0;
  }

  /** The state component's unit as shown, and what m or rad must be multiplied by. */
  shown(component) {
    return SHOWN[this.components[component].unit];
  }

  /** (T,) */
  truth(component) {
    return this.#scaled('truth', component, component);
  }

  /** (T,) What a source believes. @param {string} source a modality or `fused`. */
  mean(source, component) {
    return this.#of('mean', source, component);
  }

  /** (T,) Its standard deviation; undefined where the filter knows none, as `radius` and `surprise`. */
  sigma(source, component) {
    return this.#of('sigma', source, component);
  }

  /** (T,) or undefined: beta as the network gave it (`raw`), or the share that acted (`acting`). */
  weight(kind, modality, component) {
    const name = kind === 'raw' ? 'weights' : 'acting';
    const k = this.modalities.indexOf(modality);
    if (!this.has(name) || k < 0) return undefined;
    const { shape } = this.#columns.get(name);
    return this.#slice(name, k, shape[2] > 1 ? component : 0);
  }

  /** (T,) or undefined: number of particles that still carry weight. */
  get particles() {
    return this.#slice('effective_sample_size');
  }

  /** (T,) or undefined: squared error over the claimed covariance, over the number of components; 1 on average. */
  nees(source) {
    const k = this.modalities.indexOf(source);
    return this.#slice('nees', k < 0 ? this.modalities.length : k);
  }

  /** (T,) or undefined: what a modality measured less what was predicted. */
  innovation(modality, component) {
    return this.#scaled('innovation', component, this.modalities.indexOf(modality), component);
  }

  /** (T,) or undefined: the standard deviation that prediction and measurement claim together. */
  innovationSigma(modality, component) {
    return this.#scaled('innovation_sigma', component, this.modalities.indexOf(modality), component);
  }

  /** (T,) A source's estimate less the truth; angles wrapped. */
  offset(source, component) {
    return this.#cached(`offset ${source} ${component}`, () =>
      difference(this.mean(source, component), this.truth(component), this.shown(component).unit),
    );
  }

  /** (T,) Distance of a source's position to the true one, cm; of an angle, degrees. @param {number | 'position'} what */
  error(source, what) {
    return this.#cached(`error ${source} ${what}`, () => {
      if (what !== 'position') return this.offset(source, what).map(Math.abs);
      const [x, y] = this.position.map((i) => this.offset(source, i));
      return x.map((dx, t) => Math.hypot(dx, y[t]));
    });
  }

  /** (T,) Radius that a source claims for its position: the root of the summed variances, cm. */
  radius(source) {
    return this.#cached(`radius ${source}`, () => {
      const [x, y] = this.position.map((i) => this.sigma(source, i));
      return x?.map((sx, t) => Math.hypot(sx, y[t]));
    });
  }

  /** The fused belief's largest error of any component at a step, in its own standard deviations, and whose it is. */
  surprise(step) {
    if (!this.has('estimate_sigma')) return undefined;
    const each = this.components.map(({ name }, i) => {
      return [Math.abs(this.offset(FUSED, i)[step]) / this.sigma(FUSED, i)[step], name];
    });
    return each.sort((a, b) => b[0] - a[0])[0];
  }

  /** The picture of a step, H x W bytes, or null. */
  picture(step) {
    const [height, width] = this.header.pictures ?? [0, 0];
    return this.pictures && this.pictures.subarray(step * height * width, (step + 1) * height * width);
  }

  #of(kind, source, component) {
    const k = this.modalities.indexOf(source);
    return k < 0 ? this.#scaled(`estimate_${kind}`, component, component) : this.#scaled(`modality_${kind}`, component, k, component);
  }

  #scaled(name, component, ...index) {
    const { scale } = this.shown(component);
    return this.#cached(`${name} ${index}`, () => this.#slice(name, ...index)?.map((v) => v * scale));
  }

  /** (T,) of a column: one place of its other axes. */
  #slice(name, ...index) {
    const column = this.#columns.get(name);
    if (!column) return undefined;
    return this.#cached(`slice ${name} ${index}`, () => {
      const [steps, ...rest] = column.shape;
      const stride = rest.reduce((a, b) => a * b, 1);
      const start = index.reduce((sum, i, axis) => sum * rest[axis] + i, 0);
      return Float32Array.from({ length: steps }, (_, t) => column.data[t * stride + start]);
    });
  }

  #cached(key, compute) {
    if (!this.#cache.has(key)) this.#cache.set(key, compute());
    return this.#cache.get(key);
  }

  #blackPictures() {
    const black = new Uint8Array(this.steps);
    if (this.pictures) for (let t = 0; t < this.steps; t++) black[t] = Number(this.picture(t).every((v) => v === 0));
    return black;
  }
}

function difference(a, b, unit) {
  return a.map((value, t) => (unit === '°' ? wrapped(value - b[t]) : value - b[t]));
}

/** First and last step of each stretch where `flags` is true. @returns {[number, number][]} */
export function stretches(flags) {
  const found = [];
  for (let t = 0; t < flags.length; t++) {
    if (!flags[t]) continue;
    const start = t;
    while (t + 1 < flags.length && flags[t + 1]) t++;
    found.push([start, t]);
  }
  return found;
}
