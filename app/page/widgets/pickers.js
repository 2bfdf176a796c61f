/** Pickers in the header: task, filter, data set, episode, faults and speed; and the radio groups of all panels. */

/** @import { State, Store } from '../core/state.js' */
/** @import { DataSet, EpisodeSummary, Task } from '../types/server.js' */
/** @import { FaultDialog } from './fault_dialog.js' */

import { create, element, setOptions } from '../core/dom.js';
import { filtersOf, firstData, isComplete } from '../core/episodes.js';
import { SPEEDS } from '../core/state.js';
import { percent, plural } from '../core/units.js';
import { checkSelection, episodes } from '../data/api.js';
import { liveRunState } from '../tabs/live_runs.js';
import { faultPicker, isOfPreset } from './fault_dialog.js';

const NEARBY = 100; // listed episodes around the selected one, of a large data set
/** Value of the option that opens the search. */
export const FIND = 'find';

/**
 * Connects the pickers of the header.
 * @param {Store} store
 * @param {FaultDialog} dialog
 * @param {() => void} findEpisode opens the search for an episode
 * @returns {() => void} to be called when the catalog has changed
 */
export function connectPickers(store, dialog, findEpisode) {
  const ids = ['task', 'filter', 'data', 'episode', 'speed', 'faults'];
  const [task, filter, data, episode, speed, faultSelect] = ids.map((id) =>
    element(`#${id}`, HTMLSelectElement),
  );
  const { catalog } = store;
  const currentTask = () => store.task() ?? catalog.tasks[0];
  const showFaults = faultPicker(faultSelect, dialog, {
    none: 'as recorded',
    selected: () => store.state.faults,
    choose: (faults) => store.set({ faults, ...swapped(store.state, 'faults', faults) }),
    check: (faults) => checkSelection({ ...store.state, faults, against: '' }),
  });
  setOptions(
    speed,
    SPEEDS.map((factor) => [factor, `${factor}×`]),
  );
  const refill = () => {
    setOptions(task, names(catalog.tasks));
    setOptions(filter, names(filtersOf(currentTask(), store.state.data)));
    setOptions(data, names(currentTask().data));
    for (const select of [task, data])
      if (select.parentElement) select.parentElement.hidden = select.length < 2;
  };
  task.addEventListener('change', () => {
    const selected = store.task(task.value);
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
      setOptions(episode, [[index, index]]);
      const first = Math.max(0, index - NEARBY / 2);
      const list = await episodes(taskName, dataName, { first, limit: NEARBY }).catch(() => null);
      if (list) set.episodes = list.episodes;
      if (set !== byName(currentTask().data, store.state.data) || index !== store.state.episode)
        return;
    }
    const find = isComplete(set) ? [] : [[FIND, `Find one of ${set.count} episodes…`]];
    const options = [...find, ...set.episodes.map((entry) => [entry.index, episodeLabel(entry)])];
    setOptions(episode, options, index);
    episode.title = `Episode: ${selectedLabel(episode)}`; // where the picker is narrow
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
    task.title = `Task: ${selectedLabel(task)}`;
    filter.title = `Filter: ${selectedLabel(filter)}`;
    data.title = `Data: ${selectedLabel(data)}`;
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

/** @param {{name: string}[]} list */
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
  const hasFaults = task.fault_presets.some((preset) => isOfPreset(preset, state.faults));
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

/** Participles of the policies whose names are also those of tasks. @type {Record<string, string>} */
const POLICY_LABELS = { push: 'pushed', pull: 'pulled' };

/** @param {EpisodeSummary} episode */
export function episodeLabel({ index, policy, split, steps, contact_fraction, label }) {
  if (label) return label;
  const parts = [index, POLICY_LABELS[policy ?? ''] ?? policy, split, plural(steps, 'step')];
  if (contact_fraction !== null) parts.push(`contact ${percent(contact_fraction)}`);
  return parts.filter((part) => part !== '').join(' · ');
}

/** Handlers of the radio groups. @type {WeakMap<HTMLElement, (value: string) => void>} */
const handlers = new WeakMap();

/**
 * Creates the element of a radio group.
 * @param {string} id
 * @param {string} ariaLabel
 */
export const choiceHost = (id, ariaLabel) =>
  create('div', { id, className: 'choice', role: 'radiogroup', ariaLabel });

/**
 * Shows a radio group. Its buttons are replaced only where the options have changed, so that the focus stays.
 * @param {HTMLElement} host hidden if there are fewer than two options
 * @param {string[][] | Record<string, string>} options [value, label], or labels by value
 * @param {string} selected
 * @param {(value: string) => void} choose
 */
export function choice(host, options, selected, choose) {
  const entries = Array.isArray(options) ? options : Object.entries(options);
  host.hidden = entries.length < 2;
  handlers.set(host, choose);
  const key = JSON.stringify(entries);
  if (host.dataset.options !== key) {
    host.dataset.options = key;
    const labels = entries.map(([value, label]) => {
      const input = create('input', { type: 'radio', name: host.id, value });
      input.addEventListener('change', () => handlers.get(host)?.(value));
      return create('label', {}, input, label);
    });
    host.replaceChildren(...labels);
  }
  for (const input of host.querySelectorAll('input')) input.checked = input.value === selected;
}
