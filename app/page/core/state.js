/** The state of the page and its permalink: opening the link restores the state. */

/** @import { Maps, Range, Scale } from '../maps/map_values.js' */
/** @import { Catalog, DataSet, LiveList, Task } from '../types/server.js' */
/** @import { ColourMap } from './colours.js' */

import { SCALAR, TRACKS } from '../timeline/tracks.js';
import { MAP_QUANTITIES, SCENE_CHOICES } from './constants.js';
import { episodeRange, filtersOf, firstData, hasEpisode } from './episodes.js';
import { displayName } from './units.js';

/**
 * @typedef {object} State
 * @property {string} task
 * @property {string} filter
 * @property {string} data name of the data set
 * @property {number} episode index in the data set
 * @property {string} faults fault injection as text (docs/data.md), empty for none
 * @property {string} against differences of the comparison run (docs/api.md), empty for none
 * @property {number} step
 * @property {number | null} angle SI, value of the only component off the maps; null for the true value
 * @property {string} tab one of `TABS`
 * @property {string} component state component of the charts
 * @property {string} weights `effective` or `raw` for the fusion weights beta
 * @property {string} track lowest chart: a key of `TRACKS`, or a column of a filter's own scalars
 * @property {string} charts of the timeline from top to bottom (chart_list.js), empty for the default
 * @property {string} window visible steps such as 20-60, empty for all
 * @property {string} time axis of the timeline: `steps` or `seconds`
 * @property {string} diagnostic selected diagnostic, empty for the list
 * @property {string} options of the diagnostic, URL-encoded: size=21
 * @property {string} over episodes of the diagnosis and of diagnostics: `episode` (the selected one) or `held-out`
 * @property {string} among episodes searched for failures: `held-out` or `all`
 * @property {string} list content of the list of failures: `events`, `episodes` or `slices`
 * @property {string} by score that ranks failures
 * @property {string} phase of the failures in the list, empty for all
 * @property {Maps['quantity']} map quantity of the maps
 * @property {string} sensor that is displayed as an image, empty for the first one
 * @property {string} plane components of the maps' axes, such as x,y; empty for those of the task's map
 * @property {string} others components off the maps: `auto`, `fixed` at the true values, or `marginal`, integrated out
 * @property {Scale} scale of the maps: `normalised` or `log`
 * @property {Range} range of the maps' colours: `own` of each map, or the `same` for all
 * @property {string} axes of the maps: `offset` from the true position, or `world`
 * @property {ColourMap} colours of the maps: `viridis` or `cividis`
 * @property {string} regions of 50 and 95 % on the maps: `shown` or `hidden`
 * @property {string} cloud of particles on the maps: `hidden` or `shown`
 * @property {string} zoom of the maps: `fit`, `1` or `4`
 * @property {string} tiles `one` step on the maps, or `several` small ones, with free motion beside contact
 * @property {string} beside maps of the comparison run: `alone` if they are not used, `gain` for the difference
 * @property {string} hide hidden layers of the 3D scene, comma-separated
 * @property {string} ground map on the floor of the 3D scene
 * @property {string} height of that map: `floor` or `belief`
 * @property {string} tint of the particles: `weight` or `share`
 * @property {string} run selected fine-tuning run, empty for a new one
 * @property {string} study selected study, empty for the first one
 * @property {string} quantity of the study, empty for the first one
 * @property {string} start of the study's runs: `offset` from the truth, if the study has such runs, or at the `truth`
 * @property {string} sweep selected sweep, empty for the first one
 * @property {string} steps phase of the sweep's results
 * @property {string} match words and conditions that the results must match
 * @property {string} sort column of the results, with a minus for descending
 * @property {string} pinned columns kept at the left of the results, comma-separated
 * @property {string} x quantity of the x axis of the results. @property {string} y of the y axis
 * @property {string} cell selected result
 * @property {string} recording names of the files in the Rerun tab, separated by slashes; empty for the current run
 * @property {string} rows of the results: each of the `checkpoints`, or their mean over `seeds`
 * @property {string} groups entries of the provenance that distinguish the groups, comma-separated; empty for the default
 * @property {string} pin step whose maps are the reference of the displayed ones, URL-encoded; empty for none
 * @property {boolean} playing
 * @property {number} speed
 * @property {boolean} follow whether the cursor stays at the newest step of a live run
 * @property {boolean} atFinding whether the run opens at the step of its finding, as the link names none
 */

export const SPEEDS = [0.25, 0.5, 1, 2, 4, 8];
/** In the order of the tab bar. */
export const TABS = [
  'diagnosis',
  'scene',
  'rerun',
  'diagnostics',
  'failures',
  'compare',
  'finetune',
  'study',
  'experiments',
  'recordings',
];

/** Keys with a fixed set of values, in the order of menus, the default first. @type {Record<string, readonly string[]>} */
export const CHOICES = {
  ...SCENE_CHOICES,
  tab: ['scene', ...TABS],
  weights: ['effective', 'raw'],
  track: Object.keys(TRACKS),
  time: ['steps', 'seconds'],
  over: ['episode', 'held-out'],
  list: ['events', 'episodes', 'slices'],
  among: ['held-out', 'all'],
  map: MAP_QUANTITIES,
  others: ['auto', 'fixed', 'marginal'],
  axes: ['offset', 'world'],
  regions: ['shown', 'hidden'],
  zoom: ['fit', '1', '4'],
  cloud: ['hidden', 'shown'],
  beside: ['alone', 'gain'],
  tiles: ['one', 'several'],
  start: ['offset', 'truth'],
  rows: ['checkpoints', 'seeds'],
};
/** Keys with any text, and their defaults. */
const TEXTS = {
  faults: '',
  against: '',
  charts: '',
  window: '',
  diagnostic: '',
  options: '',
  run: '',
  study: '',
  quantity: '',
  sweep: '',
  steps: 'all',
  match: '',
  sort: '-error',
  pinned: '',
  groups: '',
  x: 'error',
  y: 'nees',
  cell: '',
  recording: '',
  pin: '',
  plane: '',
  sensor: '',
  by: 'error',
  phase: '',
  hide: '',
  ground: 'fused',
};
/** Keys that every permalink contains; it contains the others where they differ from their defaults. @type {(keyof State)[]} */
const REQUIRED_KEYS = [
  'task',
  'filter',
  'data',
  'episode',
  'step',
  'component',
  'weights',
  'track',
  'tab',
];
/** Keys and values in links from earlier versions. */
const OLD_KEYS = { recipe: 'faults', group: 'phase' };
/** @type {Record<string, string>} */
const OLD_VALUES = { acting: 'effective', moments: 'events' };

/** Keys whose changes add an entry to the browser's history. */
const HISTORY_KEYS = [
  'task',
  'filter',
  'data',
  'episode',
  'faults',
  'against',
  'tab',
  'diagnostic',
  'run',
  'study',
  'sweep',
  'recording',
];
const LINK_DELAY = 250; // ms; browsers limit how often a page may change its address

/** @typedef {'page' | 'rerun' | 'clock' | 'live'} Origin of a change of the step */
/** @typedef {(state: State, changed: Set<string>) => unknown} Listener */

/** Holds the state and notifies listeners of changes once per frame. */
export class Store {
  /** @type {State} */
  state;
  /** Origin of the last change of the step. @type {string} */
  origin = 'page';
  /** Time in ms of the input that changed the step last; null if no input did. @type {number | null} */
  inputTime = null;
  /** @type {Listener[]} */
  #listeners = [];
  /** @type {Set<string>} */
  #changed = new Set();
  #frame = 0;
  #link;
  /** @type {number | undefined} */
  #linkTimer;

  /**
   * @param {State} state
   * @param {Catalog} catalog of the names in the state
   */
  constructor(state, catalog) {
    this.state = state;
    this.catalog = catalog;
    this.#link = permalink(state);
  }

  /** Returns a task, by default the selected one. @param {string} [selected] */
  task(selected = this.state.task) {
    return this.catalog.tasks.find(({ name }) => name === selected);
  }

  /** @param {Listener} listener called in a frame after one or more changes */
  listen(listener) {
    this.#listeners.push(listener);
  }

  /**
   * @param {(keyof State)[]} keys
   * @param {(state: State) => void} listener called in a frame after changes of some of the keys
   */
  when(keys, listener) {
    this.listen((state, changed) => keys.some((key) => changed.has(key)) && listener(state));
  }

  /**
   * Changes the state. A component that the new task does not have is replaced by the first one of its map.
   * @param {Partial<State>} patch
   * @param {{origin?: Origin, inputTime?: number | null}} [cause]
   */
  set(patch, { origin = 'page', inputTime = null } = {}) {
    /** @type {Record<string, unknown>} */
    const state = this.state;
    const task = 'task' in patch && this.task(patch.task);
    const component = task && componentOf(task, patch.component ?? this.state.component);
    for (const [key, value] of Object.entries(component ? { ...patch, component } : patch)) {
      if (state[key] === value) continue;
      state[key] = value;
      this.#changed.add(key);
      if (key === 'step') [this.origin, this.inputTime] = [origin, inputTime];
    }
    if (this.#changed.size && !this.#frame) this.#frame = requestAnimationFrame(() => this.flush());
  }

  /**
   * Restores the state of an entry of the browser's history.
   * @param {State} state
   */
  restore({ speed, ...state }) {
    this.set(state);
    this.flush(true);
  }

  /**
   * Notifies the listeners at once.
   * @param {boolean} restored whether the state comes from the browser's history
   */
  flush(restored = false) {
    cancelAnimationFrame(this.#frame);
    this.#frame = 0;
    if (!this.#changed.size) return;
    const changed = this.#changed;
    this.#changed = new Set();
    for (const listener of this.#listeners) listener(this.state, changed);
    const previous = this.#link;
    this.#link = permalink(this.state);
    clearTimeout(this.#linkTimer);
    if (HISTORY_KEYS.some((key) => changed.has(key)) && !restored) {
      history.replaceState(null, '', previous);
      history.pushState(null, '', this.#link);
    } else {
      this.#linkTimer = setTimeout(() => history.replaceState(null, '', this.#link), LINK_DELAY);
    }
  }
}

/**
 * Returns the name of a component that a task has: the given one, or else the first one of its map.
 * @param {Task} task
 * @param {string} name
 */
export const componentOf = ({ components, map }, name) =>
  components.some((component) => component.name === name) ? name : map.components[0];

/**
 * Returns the query string that restores a state.
 * @param {State} state
 */
export function permalink(state) {
  const values = new Map(REQUIRED_KEYS.map((key) => [/** @type {string} */ (key), state[key]]));
  const choices = Object.entries(CHOICES).map(([key, options]) => [key, options[0]]);
  for (const [key, fallback] of [...Object.entries(TEXTS), ...choices]) {
    const value = state[/** @type {keyof State} */ (key)];
    if (value !== fallback) values.set(key, value);
  }
  if (state.angle !== null) values.set('angle', Number(state.angle.toFixed(4)));
  const pairs = [...values].map(([key, value]) => [key, String(value)]);
  return `?${new URLSearchParams(pairs)}`;
}

/**
 * Reads the state from a permalink. Unknown names are replaced by defaults and reported.
 * @param {string} search query string
 * @param {Catalog} catalog with at least one task
 * @returns {{state: State, problems: string[]}}
 */
export function parsePermalink(search, catalog) {
  const link = new LinkReader(search);
  const task = link.named('task', catalog.tasks);
  const data = link.named('data', task.data, firstData(task).name);
  const filters = filtersOf(task, data.name);
  const angle = Number(link.query.get('angle') ?? NaN);
  const [hasStep, isRunning] = [link.query.has('step'), data.live?.state === 'running'];
  /** @type {Partial<State>} */
  const state = {
    task: task.name,
    filter: link.named('filter', filters, data.live?.filter).name,
    data: data.name,
    episode: link.integer('episode', data.first, data),
    step: link.integer('step', link.query.has('episode') ? 0 : data.first_step),
    angle: Number.isFinite(angle) ? angle : null,
    component: link.choice(
      'component',
      task.components.map(({ name }) => name),
      task.map.components[0],
    ),
    playing: false,
    speed: 1,
    follow: isRunning && !hasStep,
    atFinding: !isRunning && !hasStep && link.query.has('episode'),
  };
  const texts = Object.entries(TEXTS).map(([key, fallback]) => [
    key,
    link.query.get(key)?.trim() ?? fallback,
  ]);
  const choices = Object.entries(CHOICES).map(([key, options]) => [
    key,
    link.choice(key, key === 'track' ? [...options, ...link.scalar] : options, options[0]),
  ]);
  Object.assign(state, Object.fromEntries([...texts, ...choices]), { window: link.window() });
  return { state: /** @type {State} */ (state), problems: link.problems };
}

/**
 * Completes the query string of an address that names no task: by the task of the live run that it names, or else by
 * the first example, whose own values yield to those of the address. In place of an example, an empty address opens
 * the newest live or imported run that has or awaits steps, if there is one.
 * @param {string} search query string
 * @param {Catalog} catalog
 * @param {LiveList['runs']} [runs] live runs, the newest first
 */
export function completeLink(search, { examples, tasks }, runs = []) {
  const query = new URLSearchParams(search);
  if (query.has('task')) return search;
  const newest = runs.find((run) => 'data' in run && (run.steps || run.state === 'running'));
  if (!query.size && examples.length && newest && 'data' in newest) {
    const { task, filter, data } = newest;
    return `?${new URLSearchParams({ task, filter, data })}`;
  }
  const owner = tasks.find(({ data }) =>
    data.some(({ live, name }) => live && name === query.get('data')),
  );
  if (owner) return `?${new URLSearchParams([['task', owner.name], ...query])}`;
  const first = examples.find(({ setup }) => !setup);
  if (!first) return search;
  const link = new URLSearchParams(first.link);
  const task = tasks.find(({ name }) => name === link.get('task'));
  /**
   * @param {string} key
   * @param {{name: string}[]} [items]
   */
  const fits = (key, items) =>
    !query.has(key) || items?.some(({ name }) => name === query.get(key));
  if (!fits('filter', task?.filters) || !fits('data', task?.data)) return search;
  if (query.has('episode')) link.delete('step');
  for (const [key, value] of query) link.set(key, value);
  return `?${link}`;
}

/** Reads values from a query string and collects problems. */
class LinkReader {
  /** @type {string[]} */
  problems = [];

  /** @param {string} search */
  constructor(search) {
    this.query = new URLSearchParams(search);
    for (const [old, key] of Object.entries(OLD_KEYS)) {
      const value = this.query.get(old);
      if (value !== null && !this.query.has(key)) this.query.set(key, value);
    }
  }

  /**
   * @param {string} key
   * @param {readonly string[]} options
   * @param {string} fallback
   */
  choice(key, options, fallback) {
    const text = this.query.get(key);
    if (text === null) return fallback;
    const value = options.includes(text) ? text : OLD_VALUES[text];
    if (options.includes(value)) return value;
    this.#report(key, text, `Available: ${[...new Set(options)].join(', ')}.`);
    return fallback;
  }

  /**
   * @template {{name: string}} T
   * @param {string} key
   * @param {T[]} items at least one
   * @param {string} [fallback] the first one by default
   * @returns {T}
   */
  named(key, items, fallback = items[0].name) {
    const names = items.map(({ name }) => name);
    const name = this.choice(key, names, fallback);
    return items.find((item) => item.name === name) ?? items[0];
  }

  /**
   * @param {string} key
   * @param {number} fallback
   * @param {DataSet} [set] whose episodes are valid; any integer from 0 by default
   */
  integer(key, fallback, set) {
    const text = this.query.get(key);
    if (text === null) return fallback;
    const value = Number(text);
    if (Number.isInteger(value) && value >= 0 && (!set || hasEpisode(set, value))) return value;
    const hint = set && `Available: ${episodeRange(set).join(' to ')}.`;
    this.#report(key, text, hint ?? 'It must be an integer from 0.');
    return fallback;
  }

  /** The track if it is one of a filter's own scalars, which only its trace contains. */
  get scalar() {
    const track = this.query.get('track') ?? '';
    return track.startsWith(SCALAR) ? [track] : [];
  }

  /** Reads the visible steps. */
  window() {
    const text = this.query.get('window') ?? '';
    const [, from, to] = /^(\d+(?:\.\d+)?)-(\d+(?:\.\d+)?)$/.exec(text) ?? [];
    if (!text || Number(from) < Number(to)) return text;
    this.problems.push(
      `The link has an invalid window “${text}”. It must name the first and the last visible step, such as 20-60.`,
    );
    return '';
  }

  /**
   * @param {string} key
   * @param {string} value
   * @param {string} hint
   */
  #report(key, value, hint) {
    this.problems.push(
      `The link names ${displayName(key)} “${value}”, which does not exist. ${hint}`,
    );
  }
}
