/** Pickers in the header: task, filter, data set, episode, faults and speed; and the radio groups of all panels. */

/** @import { State, Store } from '../core/state.js' */
/** @import { Catalog, DataSet, EpisodeSummary, Task } from '../types/server.js' */
/** @import { FaultDialog } from './fault_dialog.js' */

import { create, element } from '../core/dom.js';
import { filtersOf, firstData, isComplete } from '../core/episodes.js';
import { SPEEDS } from '../core/state.js';
import { percent, plural } from '../core/units.js';
import { checkSelection, episodes } from '../data/api.js';
import { liveRunState } from '../tabs/live_runs.js';
import { faultPicker } from './fault_dialog.js';

const NEARBY = 100; // listed episodes around the selected one, of a large data set
/** Value of the option that opens the search. */
export const FIND = 'find';

/** @typedef {[value: string | number, label: string | number]} Option */

/**
 * Connects the pickers of the header.
 * @param {Catalog} catalog
 * @param {Store} store
 * @param {FaultDialog} dialog
 * @param {() => void} findEpisode opens the search for an episode
 * @returns {() => void} to be called when the catalog has changed
 */
export function connectPickers(catalog, store, dialog, findEpisode) {
  const selects = {
    task: element('#task', HTMLSelectElement),
    filter: element('#filter', HTMLSelectElement),
    data: element('#data', HTMLSelectElement),
    episode: element('#episode', HTMLSelectElement),
    speed: element('#speed', HTMLSelectElement),
  };
  const { task, filter, data, episode, speed } = selects;
  const currentTask = () => byName(catalog.tasks, store.state.task) ?? catalog.tasks[0];
  const showFaults = faultPicker(element('#faults', HTMLSelectElement), dialog, {
    none: 'as recorded',
    selected: () => store.state.faults,
    choose: (faults) => store.set({ faults, ...swapped(store.state, 'faults', faults) }),
    check: (faults) => checkSelection({ ...store.state, faults, against: '' }),
  });
  fill(
    speed,
    SPEEDS.map((factor) => [factor, `${factor}×`]),
  );
  const refill = () => {
    fill(task, names(catalog.tasks));
    fill(filter, names(filtersOf(currentTask(), store.state.data)));
    fill(data, names(currentTask().data));
    for (const select of [task, data])
      if (select.parentElement) select.parentElement.hidden = select.length < 2;
  };
  task.addEventListener('change', () => {
    const selected = byName(catalog.tasks, task.value);
    if (selected) store.set(firstRun(selected, store.state));
  });
  data.addEventListener('change', () => {
    const set = byName(currentTask().data, data.value);
    if (set) store.set(set.live ? liveRunState(catalog, set.live, store.state) : switchData(set));
  });
  /** @param {DataSet} set */
  const switchData = (set) => {
    const filters = filtersOf(currentTask(), set.name);
    const { name } = byName(filters, filter.value) ?? filters[0] ?? currentTask().filters[0];
    return {
      data: set.name,
      filter: name,
      episode: set.first,
      step: set.first_step,
      playing: false,
    };
  };
  filter.addEventListener('change', () =>
    store.set({ filter: filter.value, ...swapped(store.state, 'filter', filter.value) }),
  );
  const showEpisodes = async () => {
    const set = byName(currentTask().data, store.state.data);
    if (!set) return;
    const { task: taskName, data: dataName, episode: index } = store.state;
    if (!isComplete(set) && !set.episodes.some((entry) => entry.index === index)) {
      fill(episode, [[index, index]]);
      const first = Math.max(0, index - NEARBY / 2);
      const list = await episodes(taskName, dataName, { first, limit: NEARBY }).catch(() => null);
      if (list) set.episodes = list.episodes;
      if (set !== byName(currentTask().data, store.state.data) || index !== store.state.episode)
        return;
    }
    /** @type {Option[]} */
    const options = set.episodes.map((entry) => [entry.index, episodeLabel(entry)]);
    if (!isComplete(set)) options.unshift([FIND, `Find one of ${set.count} episodes…`]);
    fill(episode, options);
    episode.value = String(index);
    episode.title = selectedLabel(episode); // where the picker is narrow
  };
  episode.addEventListener('change', () => {
    if (episode.value !== FIND)
      return store.set({ episode: Number(episode.value), step: 0, playing: false });
    episode.value = String(store.state.episode);
    findEpisode();
  });
  speed.addEventListener('change', () => store.set({ speed: Number(speed.value) }));
  const show = (/** @type {State} */ state, changed = new Set(['task'])) => {
    if (changed.has('task') || changed.has('data')) refill();
    if (changed.has('task') || changed.has('faults')) showFaults(currentTask().fault_presets);
    task.value = state.task;
    filter.value = state.filter;
    data.value = state.data;
    if (['task', 'data', 'episode'].some((key) => changed.has(key))) showEpisodes();
    speed.value = String(state.speed);
    for (const select of [filter, data]) select.title = selectedLabel(select);
  };
  show(store.state);
  store.listen(show);
  return () => show(store.state);
}

/**
 * @template {{name: string}} T
 * @param {T[]} list
 * @param {string} name
 */
const byName = (list, name) => list.find((entry) => entry.name === name);

/**
 * @param {{name: string}[]} list
 * @returns {Option[]}
 */
const names = (list) => list.map(({ name }) => [name, name]);

/** @param {HTMLSelectElement} select */
const selectedLabel = (select) => select.selectedOptions[0]?.label ?? '';

/**
 * Swaps the run and the comparison run if the comparison run is chosen.
 * @param {State} state
 * @param {'filter' | 'faults'} key
 * @param {string} value
 */
const swapped = (state, key, value) =>
  state.against === `${key}=${value}` ? { against: `${key}=${state[key]}` } : {};

/**
 * Returns the changes of the state that select the first run of a task.
 * @param {Task} task
 * @param {State} state
 */
export function firstRun(task, state) {
  const { name: data, first, first_step: step } = firstData(task);
  const filters = filtersOf(task, data);
  const hasFaults = task.fault_presets.some(({ faults }) => faults === state.faults);
  return {
    task: task.name,
    filter: (byName(filters, state.filter) ?? filters[0]).name,
    data,
    episode: first,
    faults: hasFaults ? state.faults : '',
    against: '',
    step,
    angle: null,
    component: task.map.components[0],
    plane: '',
    zoom: 'fit', // of maps of another size
    playing: false,
  };
}

/** @param {EpisodeSummary} episode */
export function episodeLabel({ index, policy, split, steps, contact_fraction, label }) {
  if (label) return label;
  const parts = [index, policy, split, plural(steps, 'step')];
  if (contact_fraction !== null) parts.push(`contact ${percent(contact_fraction)}`);
  return parts.filter((part) => part !== '').join(' · ');
}

/**
 * @param {HTMLSelectElement} select
 * @param {Option[]} options
 */
function fill(select, options) {
  select.replaceChildren(
    ...options.map(([value, label]) => new Option(String(label), String(value))),
  );
  select.disabled = false;
}

/** Handlers of the radio groups. @type {WeakMap<HTMLElement, (value: string) => void>} */
const handlers = new WeakMap();

/**
 * Shows a radio group. Its buttons are replaced only where the options have changed, so that the focus stays.
 * @param {HTMLElement} host hidden if there are fewer than two options
 * @param {[value: string, label: string][]} options
 * @param {string} selected
 * @param {(value: string) => void} choose
 */
export function choice(host, options, selected, choose) {
  host.hidden = options.length < 2;
  handlers.set(host, choose);
  const key = JSON.stringify(options);
  if (host.dataset.options !== key) {
    host.dataset.options = key;
    host.replaceChildren(...options.map(([value, label]) => radioButton(host, value, label)));
  }
  for (const input of host.querySelectorAll('input')) input.checked = input.value === selected;
}

/**
 * @param {HTMLElement} host
 * @param {string} value
 * @param {string} label
 */
function radioButton(host, value, label) {
  const input = create('input', { type: 'radio', name: host.id, value });
  input.addEventListener('change', () => handlers.get(host)?.(value));
  return create('label', {}, input, label);
}
