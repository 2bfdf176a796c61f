/** A trace's numbers as the page shows them: columns over time, in cm and degrees. */

import { SHOWN, wrapped } from '../core/units.js';

const FUSED = 'fused';

export class Trace {
  /** Whose steps are still coming: their stream (stream.js), and what is known of the run; else undefined. */
  stream;
  live;
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
    this.pictures = pictures && new Uint8Array(pictures);
    for (const { name, shape, offset } of header.columns) {
      const size = shape.reduce((a, b) => a * b, 1);
      this.#columns.set(name, { data: new Float32Array(buffer, offset, size), shape });
    }
    const index = (name) => this.components.findIndex((c) => c.name === name);
    /** Positions in the state of the two components that span the maps. */
    this.position = [index(task.map.x), index(task.map.y)];
    this.angles = this.components.map((c, i) => (c.unit === 'rad' ? i : -1)).filter((i) => i >= 0);
    this.#derive(0);
  }

  /**
   * More steps at the end. A column that comes late was not known before, one that stays away is not known now.
   * @param {import('./live_stream.js').Block} block @returns {boolean} whether there are columns that were not there before
   */
  grow({ steps, columns, buffer, pictures }) {
    const before = this.steps;
    const given = new Map(columns.map((column) => [column.name, column]));
    const late = columns.filter(({ name }) => !this.has(name));
    for (const { name, shape } of late) this.#columns.set(name, { shape: [before, ...shape.slice(1)], data: new Float32Array(before * stride(shape)).fill(NaN) });
    for (const [name, column] of this.#columns) {
      const [used, more] = [before, steps].map((count) => count * stride(column.shape));
      const found = given.get(name);
      column.data = longer(column.data, used, found ? new Float32Array(buffer, found.offset, more) : new Float32Array(more).fill(NaN));
      column.shape = [before + steps, ...column.shape.slice(1)];
    }
    if (pictures) this.pictures = longer(this.pictures, (before * pictures.byteLength) / steps, new Uint8Array(pictures));
    this.steps += steps;
    this.#cache.clear();
    this.#derive(before);
    return late.length > 0;
  }

  /** Whose estimates there are: each modality alone where it is known, and all of them; one alone is the same as all. */
  get sources() {
    return this.fuses && this.has('modality_mean') ? [...this.modalities, FUSED] : [FUSED];
  }

  /** Whether the truth of a step is known. */
  knows(step) {
    return this.position.every((i) => Number.isFinite(this.truth(i)[step]));
  }

  /** Whether several modalities are fused, or one measurement model, or none, decides alone. */
  get fuses() {
    return this.modalities.length > 1;
  }

  /** What a source is called. */
  called(source) {
    return source === FUSED && !this.fuses ? 'estimate' : source;
  }

  /** Whether another trace is of the same episode, step by step; filter and faults may differ. */
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
      const [values, width] = [new Float32Array(steps), stride(column.shape)];
      let at = index.reduce((sum, i, axis) => sum * rest[axis] + i, 0);
      for (let t = 0; t < steps; t++, at += width) values[t] = column.data[at];
      return values;
    });
  }

  #cached(key, compute) {
    if (!this.#cache.has(key)) this.#cache.set(key, compute());
    return this.#cache.get(key);
  }

  /** Contact, and which pictures are black; of the steps from `first` on. */
  #derive(first) {
    this.contact = this.#slice('contact') ?? new Float32Array(this.steps);
    const black = new Uint8Array(this.steps);
    if (first) black.set(this.black);
    if (this.pictures) for (let t = first; t < this.steps; t++) black[t] = Number(this.picture(t).every((v) => v === 0));
    this.black = black;
  }
}

/** Numbers that a step has in a column of this shape. */
const stride = ([, ...rest]) => rest.reduce((a, b) => a * b, 1);

/** An array with more behind the `used` first of its values; it has room for as many again. */
function longer(array, used, more) {
  const all = used + more.length;
  if (array.length < all) {
    const before = array;
    array = new before.constructor(2 * all);
    array.set(before.subarray(0, used));
  }
  array.set(more, used);
  return array;
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
