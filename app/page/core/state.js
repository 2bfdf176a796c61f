/** The one state of the page, and its address: a pasted link opens the same moment. */

import { KINDS } from '../timeline/tracks.js';
import { spoken } from './units.js';

/**
 * @typedef {object} State
 * @property {string} task @property {string} filter @property {string} data set of episodes
 * @property {number} episode index in it
 * @property {string} faults how the sensors are broken, as text (docs/data.md); empty where they are not
 * @property {string} against what differs in the other run that this one is compared with (docs/api.md); empty without one
 * @property {number} step @property {number | null} angle rad at which the maps are cut; null follows the truth
 * @property {'scene' | 'rerun' | 'diagnostics' | 'failures' | 'compare' | 'finetune' | 'study' | 'recordings'} tab
 * @property {string} component whose estimates are drawn @property {'raw' | 'acting'} weights
 * @property {string} track the lowest chart: a name of `KINDS` (tracks.js)
 * @property {string} window steps that the time line shows, as 20-60; empty for all of them
 * @property {string} diagnostic that is open, empty for the list of all
 * @property {string} options of the open one, as in an address: size=21
 * @property {'episode' | 'held-out'} over what diagnostics are made: this episode, or all that are held out
 * @property {'held-out' | 'all'} among which episodes failures are looked for @property {'moments' | 'episodes'} list what is listed of them
 * @property {string} by measure that ranks failures @property {string} group the only one that is listed, empty for all
 * @property {string} scale of the maps, `range`, `axes`, `colours`, `regions`, `cloud`, `zoom`: see `MAPS`
 * @property {string} hide layers of the 3D scene that are hidden, with commas @property {string} ground map on its floor @property {string} height it lies at @property {string} tint of particles
 * @property {string} run of fine-tuning that is open, empty for a new one
 * @property {string} study that is shown @property {string} quantity of it; empty for the first of each
 * @property {string} pin moment whose maps the shown ones are set against, as in an address; empty for none
 * @property {boolean} playing @property {number} speed
 * @property {boolean} follow whether the cursor stays at the newest step of a live run; a link without a step begins so
 */

export const SPEEDS = [0.25, 0.5, 1, 2, 4, 8];
/** How likelihood maps are shown: the colours' scale, whether all share its range, the axes, what lies on top, what they gain on the other run. */
const MAPS = { scale: ['normalised', 'log'], range: ['own', 'same'], axes: ['offset', 'world'], colours: ['viridis', 'cividis'], regions: ['shown', 'hidden'], zoom: ['fit', '1', '4'], cloud: ['hidden', 'shown'], beside: ['alone', 'gain'] };
const CHOICES = { height: ['floor', 'belief'], tint: ['weight', 'share'], tab: ['scene', 'rerun', 'diagnostics', 'failures', 'compare', 'finetune', 'study', 'recordings'], weights: ['raw', 'acting'], track: Object.keys(KINDS), over: ['episode', 'held-out'], list: ['moments', 'episodes'], among: ['held-out', 'all'], ...MAPS };
const FLOOR = 'fused'; // the map on the scene's floor where none is chosen
const WORST = 'error'; // the measure that ranks failures where none is chosen
/** Of the state: another one is another place in the browser's history. */
const PLACES = ['task', 'filter', 'data', 'episode', 'faults', 'against', 'tab', 'diagnostic', 'run', 'study'];
const ADDRESS_PAUSE = 250; // ms; browsers refuse pages that change their address all the time

/** Holds the state; tells listeners once a frame what has changed. */
export class Store {
  /** @type {State} */
  state;
  /** Who moved the step last: `page`, `scene`, `rerun`, `clock`. */
  origin = 'page';
  /** When the input came that moved the step last, ms; null where nobody's hand did. */
  inputTime = null;
  #listeners = [];
  #changed = new Set();
  #frame = 0;
  #address;
  #addressTimer = 0;

  /** @param {State} state */
  constructor(state) {
    this.state = state;
    this.#address = address(state);
  }

  /** @param {(state: State, changed: Set<string>) => void} listener called in a frame after one or more changes. */
  listen(listener) {
    this.#listeners.push(listener);
  }

  /** @param {Partial<State>} patch @param {{origin?: string, inputTime?: number | null}} [cause] */
  set(patch, { origin = 'page', inputTime = null } = {}) {
    for (const [key, value] of Object.entries(patch)) {
      if (this.state[key] === value) continue;
      this.state[key] = value;
      this.#changed.add(key);
      if (key === 'step') [this.origin, this.inputTime] = [origin, inputTime];
    }
    if (this.#changed.size && !this.#frame) this.#frame = requestAnimationFrame(() => this.flush());
  }

  /** The browser has gone back, or on, to a place. @param {State} state of its address */
  stand({ speed, ...state }) {
    this.set(state);
    this.flush(true);
  }

  /** Tells the listeners now. @param {boolean} stood whether the browser's history is at this place already */
  flush(stood = false) {
    cancelAnimationFrame(this.#frame);
    this.#frame = 0;
    if (!this.#changed.size) return;
    const changed = this.#changed;
    this.#changed = new Set();
    for (const listener of this.#listeners) listener(this.state, changed);
    const before = this.#address;
    this.#address = address(this.state);
    clearTimeout(this.#addressTimer);
    if (PLACES.some((key) => changed.has(key)) && !stood) {
      history.replaceState(null, '', before);
      history.pushState(null, '', this.#address);
    } else this.#addressTimer = setTimeout(() => history.replaceState(null, '', this.#address), ADDRESS_PAUSE);
  }
}

/** @param {State} state @returns {string} what follows the `?` says all of it that a link should keep. */
export function address(state) {
  const { task, filter, data, episode, faults, step, angle, tab, component, weights, track, window, diagnostic, options, over, by, group } = state;
  const kept = { task, filter, data, episode, step, component, weights, track, tab };
  if (faults) kept.faults = faults;
  if (state.against) kept.against = state.against;
  if (window) kept.window = window;
  if (diagnostic) kept.diagnostic = diagnostic;
  if (options) kept.options = options;
  if (over !== CHOICES.over[0]) kept.over = over;
  for (const key of ['run', 'study', 'quantity', 'pin']) if (state[key]) kept[key] = state[key];
  if (by !== WORST) kept.by = by;
  if (group) kept.group = group;
  if (state.hide) kept.hide = state.hide;
  if (state.ground !== FLOOR) kept.ground = state.ground;
  for (const key of ['list', 'among', 'height', 'tint', ...Object.keys(MAPS)]) if (state[key] !== CHOICES[key][0]) kept[key] = state[key];
  if (angle !== null) kept.angle = Number(angle.toFixed(4));
  return `?${new URLSearchParams(kept)}`;
}

/**
 * The state that an address asks for, as far as the catalog has it.
 * @param {string} search @param {import('../data/api.js').Catalog} catalog with at least one task.
 * @returns {{state: State, problems: string[]}} a line for each part that was not to be had.
 */
export function resolve(search, catalog) {
  const asked = new URLSearchParams(search);
  const problems = [];
  const pick = (key, names, fallback, kind = key) => {
    const name = asked.get(key);
    if (name === null || names.includes(name)) return name ?? fallback;
    problems.push(`The link asks for ${kind} “${name}”, which does not exist. Available: ${names.join(', ')}.`);
    return fallback;
  };
  const pickOf = (key, all, fallback = all[0].name) => all.find(({ name }) => name === pick(key, all.map((one) => one.name), fallback));
  const task = pickOf('task', catalog.tasks);
  const data = pickOf('data', task.data);
  const state = {
    task: task.name,
    filter: pickOf('filter', task.filters.filter(({ live }) => !live || live === data.name), data.live?.filter).name,
    data: data.name,
    episode: number(asked, 'episode', data.first, data.episodes.map((e) => e.index), problems),
    faults: asked.get('faults')?.trim() ?? '',
    against: asked.get('against') ?? '',
    step: number(asked, 'step', 0, null, problems),
    angle: asked.has('angle') && Number.isFinite(Number(asked.get('angle'))) ? Number(asked.get('angle')) : null,
    component: pick('component', task.components.map((c) => c.name), task.map.x),
    window: stretch(asked, problems),
    diagnostic: asked.get('diagnostic') ?? '',
    options: asked.get('options') ?? '',
    by: asked.get('by') ?? WORST,
    group: asked.get('group') ?? '',
    hide: asked.get('hide') ?? '',
    ground: asked.get('ground') ?? FLOOR,
    run: asked.get('run') ?? '',
    study: asked.get('study') ?? '',
    quantity: asked.get('quantity') ?? '',
    pin: asked.get('pin') ?? '',
    playing: false,
    speed: 1,
    follow: data.live?.state === 'running' && !asked.has('step'),
  };
  for (const [key, values] of Object.entries(CHOICES)) state[key] = pick(key, values, values[0], spoken(key));
  return { state, problems };
}

function stretch(asked, problems) {
  const text = asked.get('window') ?? '';
  const [, from, to] = /^(\d+(?:\.\d+)?)-(\d+(?:\.\d+)?)$/.exec(text) ?? [];
  if (!text || Number(from) < Number(to)) return text;
  problems.push(`The link asks for window “${text}”, which cannot be shown. It is the first and the last step in view, as 20-60.`);
  return '';
}

function number(asked, key, fallback, allowed, problems) {
  if (!asked.has(key)) return fallback;
  const value = Number(asked.get(key));
  if (Number.isInteger(value) && value >= 0 && (allowed === null || allowed.includes(value))) return value;
  const range = allowed ? ` Available: ${Math.min(...allowed)} to ${Math.max(...allowed)}.` : ' It is an integer from 0.';
  problems.push(`The link asks for ${key} “${asked.get(key)}”, which does not exist.${range}`);
  return fallback;
}
