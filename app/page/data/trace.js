/** A trace as the page displays it: columns over time, in units for display. */

/** @import { LiveRun, Selection, Task, TraceHeader } from '../types/server.js' */
/** @import { Column, Series } from './arrays.js' */
/** @import { Block, LiveStream } from './live_stream.js' */

import {
  displayName,
  displayUnit,
  fixed,
  mainUnit,
  stepLabel,
  wrapDegrees,
} from '../core/units.js';
import { append, norm, slice, stride } from './arrays.js';
import { Channels } from './channels.js';

const FUSED = 'fused';
const MAX_TIME_DIGITS = 4;

/**
 * Returns the label of a modality's estimate: the prior of the fused filter, updated with this modality only.
 * @param {string} modality
 */
export const updateLabel = (modality) => `${displayName(modality)}-only update`;

export class Trace {
  /** Source of further steps of a live run. @type {LiveStream | undefined} */
  stream;
  /** @type {LiveRun | undefined} */
  live;
  /** @type {Map<string, Column>} */
  #columns = new Map();
  /** @type {Map<string, Series | undefined>} */
  #cache = new Map();
  /** Readings of sensors, and innovations in the space of the measurements. */
  channels = new Channels(this.#columns);

  /**
   * @param {Task} task
   * @param {Selection} selection
   * @param {TraceHeader} header
   * @param {ArrayBuffer} buffer columns, end to end
   * @param {ArrayBuffer | null} images of the first displayed sensor, T x H x W x channels bytes
   */
  constructor(task, selection, header, buffer, images) {
    this.task = task;
    this.selection = selection;
    this.header = header;
    this.steps = header.steps;
    this.dt = header.dt;
    this.components = header.components;
    this.modalities = header.modalities;
    this.images = images && new Uint8Array(images);
    for (const { name, shape, offset, channels } of header.columns) {
      const size = shape.reduce((a, b) => a * b, 1);
      this.#columns.set(name, { data: new Float32Array(buffer, offset, size), shape, channels });
    }
    /** Indices of the state components of the main error. */
    this.main = task.main.indices;
    this.mainUnit = mainUnit(task).unit;
    this.angles = this.components.map((c, i) => (c.unit === 'rad' ? i : -1)).filter((i) => i >= 0);
    /** Whether each step is in contact. @type {Series} */
    this.contact = new Float32Array();
    /** Whether an image of each step is blacked out. @type {Series} */
    this.blackout = new Float32Array();
    /** Whether a fault was injected at each step. @type {Series} */
    this.faulty = new Float32Array();
    this.#update();
  }

  /**
   * Appends steps. Missing values of new columns, and of columns that the block lacks, are NaN.
   * @param {Pick<Block, 'steps' | 'columns' | 'buffer' | 'images'>} block
   * @returns {boolean} whether the block has new columns
   */
  grow({ steps, columns, buffer, images }) {
    const before = this.steps;
    const headers = new Map(columns.map((column) => [column.name, column]));
    const added = columns.filter(({ name }) => !this.has(name));
    for (const { name, shape, channels } of added)
      this.#columns.set(name, {
        channels,
        shape: [before, ...shape.slice(1)],
        data: new Float32Array(before * stride(shape)).fill(NaN),
      });
    for (const [name, column] of this.#columns) {
      const [used, size] = [before, steps].map((count) => count * stride(column.shape));
      const header = headers.get(name);
      const values = header
        ? new Float32Array(buffer, header.offset, size)
        : new Float32Array(size).fill(NaN);
      column.data = append(column.data, used, values);
      column.shape = [before + steps, ...column.shape.slice(1)];
      // Innovations have the names of the sensor's channels once there is a measurement.
      if (header?.channels && values.some(Number.isFinite)) column.channels = header.channels;
    }
    if (images && this.images) {
      const used = (before * images.byteLength) / steps;
      this.images = append(this.images, used, new Uint8Array(images));
    }
    this.steps += steps;
    this.#cache.clear();
    this.channels.clear();
    this.#update();
    return added.length > 0;
  }

  /**
   * Returns the time since step 0 in s.
   * @param {number} step
   */
  seconds(step) {
    return this.timestamp(step) ?? step * this.dt;
  }

  /**
   * Returns the time since step 0 with its unit, such as 2.60 s, with decimals that distinguish neighbouring steps.
   * @param {number} step
   */
  timeText(step) {
    const digits = Math.max(1, Math.ceil(-Math.log10(this.dt) - 1e-9));
    return `${fixed(this.seconds(step), Math.min(digits, MAX_TIME_DIGITS))} s`;
  }

  /**
   * Returns the time of a step in s since step 0; null if the data have no timestamps.
   * @param {number} step
   */
  timestamp(step) {
    return this.#slice('time')?.[step] ?? null;
  }

  /**
   * Names a step, with its time where the data have timestamps.
   * @param {number} step
   */
  stepLabel(step) {
    return stepLabel(step, this.timestamp(step));
  }

  /** Duration of the steps: `0.10 s`, or the shortest and the longest. */
  get stepText() {
    const times = this.#slice('time');
    const digits = Math.max(2, -Math.floor(Math.log10(this.dt)));
    if (!times || times.length < 2) return `${fixed(this.dt, digits)} s`;
    const steps = times
      .subarray(1)
      .map((time, i) => time - times[i])
      .sort();
    for (let more = 0; more < 3; more++) {
      const [low, high] = [steps[0], steps[steps.length - 1]].map((step) =>
        fixed(step, digits + more),
      );
      if (low !== high) return `${low} to ${high} s`;
    }
    return `${fixed(this.dt, digits)} s`;
  }

  /** Columns of the filter's own scalars. */
  get scalars() {
    return this.channels.columns('extra/');
  }

  /**
   * Returns the values of one of the filter's own scalars.
   * @param {string} column
   */
  scalar(column) {
    return this.#slice(column);
  }

  /** Names of the estimates: the image-only and haptics-only updates if the filter has them, and the fused one. */
  get sources() {
    return this.fuses && this.has('modality_mean') ? [...this.modalities, FUSED] : [FUSED];
  }

  /**
   * Returns whether the true value of the main error is known.
   * @param {number} step
   */
  hasTruth(step) {
    return this.main.every((i) => Number.isFinite(this.truth(i)[step]));
  }

  /** Names of the groups of steps by covariate, such as contact. */
  get groups() {
    return this.header.groups;
  }

  /**
   * Returns whether each step belongs to a group (0 or 1); empty for an unknown name.
   * @param {string} name
   * @returns {Series}
   */
  group(name) {
    const index = this.groups.indexOf(name);
    return (index < 0 ? undefined : this.#slice('groups', index)) ?? new Float32Array();
  }

  /** Whether the filter fuses several modalities. */
  get fuses() {
    return this.modalities.length > 1;
  }

  /**
   * Returns the label of an estimate.
   * @param {string} source
   */
  label(source) {
    if (source === FUSED && !this.fuses) return 'estimate';
    return this.modalities.includes(source) ? updateLabel(source) : source;
  }

  /** The modality of a standalone run; undefined for a run with all modalities. @returns {string | undefined} */
  get standalone() {
    return this.header.settings?.standalone;
  }

  /** Modalities whose standalone filter differs from this one. @returns {string[]} */
  get inputs() {
    const { kind } = this.header;
    if (kind === 'external' || this.standalone) return [];
    const names = this.modalities.length ? this.modalities : this.task.modalities;
    const inputs = [...new Set(names.flatMap((name) => name.split('+')))];
    return inputs.length > 1 ? inputs : [];
  }

  /**
   * Returns whether another trace has the same episode; filter and faults may differ.
   * @param {Trace} other
   */
  hasSameEpisode({ selection, steps }) {
    const { task, data, episode } = this.selection;
    return (
      steps === this.steps &&
      selection.task === task &&
      selection.data === data &&
      selection.episode === episode
    );
  }

  /** First and last step of each intervention. @returns {[number, number][]} */
  get interventions() {
    return (this.header.settings?.edits ?? []).map(({ from, to }) => [from, to - 1]);
  }

  /** @param {string} column */
  has(column) {
    return this.#columns.has(column);
  }

  /** Number of weights of each modality: one, or one per state component. */
  get weightWidth() {
    const column = this.#columns.get('weights') ?? this.#columns.get('effective_weights');
    return column?.shape[2] ?? 0;
  }

  /**
   * Returns the display unit of a state component.
   * @param {number} component
   */
  unitOf(component) {
    return displayUnit(this.components[component]);
  }

  /**
   * @param {number} component
   * @returns {Series}
   */
  truth(component) {
    return this.#scaled('truth', component, component) ?? new Float32Array();
  }

  /**
   * Returns the mean of an estimate; undefined if the filter has no such estimate.
   * @param {string} source a modality or `fused`
   * @param {number} component
   */
  mean(source, component) {
    return this.#estimate('mean', source, component);
  }

  /**
   * Returns the predicted standard deviation; undefined for a filter without a covariance.
   * @param {string} source
   * @param {number} component
   */
  sigma(source, component) {
    return this.#estimate('sigma', source, component);
  }

  /**
   * Returns the weights of a modality; undefined for a filter without weights.
   * @param {string} kind `raw`: fusion weight beta, the output of the network; `effective`: its share in the posterior
   * @param {string} modality
   * @param {number} component
   */
  weight(kind, modality, component) {
    const name = kind === 'raw' ? 'weights' : 'effective_weights';
    const index = this.modalities.indexOf(modality);
    const column = this.#columns.get(name);
    if (!column || index < 0) return undefined;
    return this.#slice(name, index, column.shape[2] > 1 ? component : 0);
  }

  /**
   * Returns how far the update of a modality moves the prediction, in predicted standard deviations; undefined if the
   * prediction is unknown.
   * @param {string} modality
   * @param {number} component
   */
  updateSize(modality, component) {
    return this.#slice('update_size', this.modalities.indexOf(modality), component);
  }

  /** Effective sample size; undefined for a filter without particles. */
  get effectiveSampleSize() {
    return this.#slice('effective_sample_size');
  }

  /**
   * Returns the NEES divided by the number of components; undefined without a covariance.
   * @param {string} source
   */
  nees(source) {
    const index = this.modalities.indexOf(source);
    return this.#slice('nees', index < 0 ? this.modalities.length : index);
  }

  /**
   * Returns the innovation of a modality; undefined if the filter has none.
   * @param {string} modality
   * @param {number} component
   */
  innovation(modality, component) {
    return this.#scaled('innovation', component, this.modalities.indexOf(modality), component);
  }

  /**
   * Returns the predicted standard deviation of the innovation.
   * @param {string} modality
   * @param {number} component
   */
  innovationSigma(modality, component) {
    const index = this.modalities.indexOf(modality);
    return this.#scaled('innovation_sigma', component, index, component);
  }

  /**
   * Returns the difference between an estimate and the true value, with angles wrapped.
   * @param {string} source
   * @param {number} component
   */
  offset(source, component) {
    return this.#cached(`offset ${source} ${component}`, () => {
      const [mean, truth] = [this.mean(source, component), this.truth(component)];
      const isAngle = this.unitOf(component).unit === '°';
      return mean?.map((v, t) => (isAngle ? wrapDegrees(v - truth[t]) : v - truth[t]));
    });
  }

  /**
   * Returns the mean of an estimate for a chart with the true values. Of an angle, the whole turns that differ from the
   * truth are left out, so that it jumps by a turn where the truth does; undefined if the filter has no such estimate.
   * @param {string} source
   * @param {number} component
   */
  nearTruth(source, component) {
    return this.#cached(`near truth ${source} ${component}`, () => {
      const [mean, truth] = [this.mean(source, component), this.truth(component)];
      const offset = this.offset(source, component);
      if (!offset || this.unitOf(component).unit !== '°') return mean;
      return mean?.map((v, t) => (Number.isFinite(offset[t]) ? truth[t] + offset[t] : v));
    });
  }

  /**
   * Returns the absolute error of an estimate, such as the distance of the position.
   * @param {string} source
   * @param {number | 'main'} quantity a state component or the main error
   */
  error(source, quantity) {
    return this.#cached(`error ${source} ${quantity}`, () => {
      if (quantity !== 'main') return this.offset(source, quantity)?.map(Math.abs);
      return norm(this.main.map((i) => this.offset(source, i)));
    });
  }

  /**
   * Returns the predicted standard deviation of the main error: the root of the summed variances.
   * @param {string} source
   */
  mainSigma(source) {
    return this.#cached(`main sigma ${source}`, () =>
      norm(this.main.map((i) => this.sigma(source, i))),
    );
  }

  /**
   * Returns the largest error of a component of the fused estimate, in predicted standard deviations.
   * @param {number} step
   * @returns {{sigmas: number, component: string} | undefined} undefined without a covariance
   */
  largestDeviation(step) {
    if (!this.has('estimate_sigma')) return undefined;
    const deviations = this.components.map(({ name }, i) => {
      const [offset, sigma] = [this.offset(FUSED, i), this.sigma(FUSED, i)];
      return {
        sigmas: Math.abs(offset?.[step] ?? NaN) / (sigma?.[step] ?? NaN),
        component: name,
      };
    });
    return deviations.sort((a, b) => b.sigmas - a.sigmas)[0];
  }

  /**
   * Returns the image of the first displayed sensor at a step, H x W x channels bytes.
   * @param {number} step
   */
  image(step) {
    const [sensor] = this.header.sensors;
    return this.images && sensor ? imageAt(this.images, sensor, step) : null;
  }

  /**
   * @param {'mean' | 'sigma'} kind
   * @param {string} source
   * @param {number} component
   */
  #estimate(kind, source, component) {
    const index = this.modalities.indexOf(source);
    return index < 0
      ? this.#scaled(`estimate_${kind}`, component, component)
      : this.#scaled(`modality_${kind}`, component, index, component);
  }

  /**
   * Returns a slice of a column in the display unit of a component.
   * @param {string} name
   * @param {number} component
   * @param {...number} index
   */
  #scaled(name, component, ...index) {
    const { scale } = this.unitOf(component);
    return this.#cached(`${name} ${index}`, () =>
      this.#slice(name, ...index)?.map((v) => v * scale),
    );
  }

  /**
   * Returns the values over time at an index of the other axes; undefined if there is no such column.
   * @param {string} name
   * @param {...number} index
   */
  #slice(name, ...index) {
    const column = this.#columns.get(name);
    if (!column) return undefined;
    return this.#cached(`slice ${name} ${index}`, () => slice(column, index));
  }

  /**
   * @param {string} key
   * @param {() => Series | undefined} compute
   */
  #cached(key, compute) {
    if (!this.#cache.has(key)) this.#cache.set(key, compute());
    return this.#cache.get(key);
  }

  /** Names of the injected faults and their sensors: `injected: image frozen, sensor bias (radar)`. */
  get faultLabel() {
    const names = this.header.faults.split(',').map((fault) => {
      const [name, value = ''] = fault.split(':')[0].split('=');
      return Number.isNaN(Number(value)) ? `${name} (${value})` : name;
    });
    return `injected: ${names.join(', ').replaceAll('_', ' ')}`;
  }

  #update() {
    this.contact = this.#slice('contact') ?? new Float32Array(this.steps);
    this.blackout = this.#slice('blackout') ?? new Float32Array(this.steps);
    this.faulty = this.#slice('faulty') ?? new Float32Array(this.steps);
  }
}

/**
 * Returns the bytes of one of the images of a sensor, or of its points: x and y as float32.
 * @param {Uint8Array} images
 * @param {{height: number, width: number, channels: number, points: number}} sensor
 * @param {number} step
 */
export function imageAt(images, { height, width, channels, points }, step) {
  const size = points ? 8 * points : height * width * channels;
  return images.subarray(step * size, (step + 1) * size);
}
