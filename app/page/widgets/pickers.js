/** What is shown: task, filter, episode, speed; and the small choices above the time line. */

import { checkSelection } from '../data/api.js';
import { showing } from '../tabs/live_runs.js';
import { faultPicker } from './fault_dialog.js';
import { SPEEDS } from '../core/state.js';
import { percent } from '../core/units.js';

/**
 * @param {import('../data/api.js').Catalog} catalog @param {import('../core/state.js').Store} store @param {import('./fault_dialog.js').FaultSheet} sheet
 * @returns {() => void} to be called when the catalog has changed
 */
export function pickers(catalog, store, sheet) {
  const ids = ['task', 'filter', 'data', 'episode', 'speed'];
  const [task, filter, data, episode, speed] = ids.map((id) => document.getElementById(id));
  const named = (list, name) => list.find((one) => one.name === name);
  const current = () => named(catalog.tasks, store.state.task);
  const names = (list) => list.map(({ name }) => [name, name]);
  /** The filters of this task that a data set can be shown with: one known by its live run alone, with no other. */
  const usable = (set) => current().filters.filter(({ live }) => !live || live === set);
  // Who chooses what this run is compared with sees the two change places.
  const swapped = (key, value) =>
    store.state.against === `${key}=${value}` ? { against: `${key}=${store.state[key]}` } : {};
  const showFaults = faultPicker(document.getElementById('faults'), sheet, {
    none: 'as recorded',
    chosen: () => store.state.faults,
    choose: (faults) => store.set({ faults, ...swapped('faults', faults) }),
    check: (faults) => checkSelection({ ...store.state, faults, against: '' }),
  });
  fill(
    speed,
    SPEEDS.map((s) => [s, `${s}×`]),
  );
  const refill = () => {
    fill(task, names(catalog.tasks));
    fill(filter, names(usable(store.state.data)));
    fill(data, names(current().data));
    fill(
      episode,
      (named(current().data, store.state.data)?.episodes ?? []).map((e) => [e.index, described(e)]),
    );
    // A choice of one is none.
    for (const select of [task, data]) select.parentElement.hidden = select.length < 2;
  };
  task.addEventListener('change', () => {
    const {
      name,
      filters,
      data: [{ name: data, first }],
      fault_presets,
      map,
    } = named(catalog.tasks, task.value);
    const filter = (named(filters, store.state.filter) ?? filters[0]).name;
    const faults = fault_presets.some((r) => r.faults === store.state.faults)
      ? store.state.faults
      : '';
    store.set({
      task: name,
      filter,
      data,
      episode: first,
      faults,
      against: '',
      step: 0,
      angle: null,
      component: map.x,
      playing: false,
    });
  });
  data.addEventListener('change', () => {
    const { live, first } = named(current().data, data.value);
    const { name } = named(usable(data.value), filter.value) ?? current().filters[0];
    store.set(
      live
        ? showing(catalog, live, store.state)
        : { data: data.value, filter: name, episode: first, step: 0, playing: false },
    );
  });
  filter.addEventListener('change', () =>
    store.set({ filter: filter.value, ...swapped('filter', filter.value) }),
  );
  episode.addEventListener('change', () =>
    store.set({ episode: Number(episode.value), step: 0, playing: false }),
  );
  speed.addEventListener('change', () => store.set({ speed: Number(speed.value) }));
  const show = (state, changed = new Set(['task'])) => {
    if (changed.has('task') || changed.has('data')) refill();
    if (changed.has('task') || changed.has('faults')) showFaults(current().fault_presets);
    for (const select of [task, filter, data, episode, speed]) select.value = state[select.id];
  };
  show(store.state);
  store.listen(show);
  return () => show(store.state);
}

function described({ index, policy, split, steps, contact_fraction, label }) {
  return (
    label ??
    [index, policy, split, `${steps} steps`, `contact ${percent(contact_fraction)}`]
      .filter((part) => part !== '')
      .join(' · ')
  );
}

function fill(select, options) {
  select.replaceChildren(...options.map(([value, text]) => new Option(text, value)));
  select.disabled = false;
}

/**
 * One choice of a few, as radio buttons in a row. They are made anew only where the options are others: the focus stays.
 * @param {HTMLElement} host @param {[string, string][]} options values and what they are called
 * @param {string} chosen @param {(value: string) => void} choose
 */
export function choice(host, options, chosen, choose) {
  host.hidden = options.length < 2;
  choosing.set(host, choose);
  const shown = JSON.stringify(options);
  if (host.dataset.options !== shown) {
    host.dataset.options = shown;
    host.replaceChildren(...options.map(([value, text]) => option(host, value, text)));
  }
  for (const input of host.querySelectorAll('input')) input.checked = input.value === chosen;
}

const choosing = new WeakMap(); // host -> what is to be done with a choice

function option(host, value, text) {
  const label = document.createElement('label');
  const input = Object.assign(document.createElement('input'), {
    type: 'radio',
    name: host.id,
    value,
  });
  input.addEventListener('change', () => choosing.get(host)(value));
  label.append(input, text);
  return label;
}
