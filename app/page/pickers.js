/** What is shown: task, filter, episode, speed; and the small choices above the time line. */

import { recipes } from './recipes.js';
import { SPEEDS } from './state.js';
import { percent } from './units.js';

/** @param {import('./api.js').Catalog} catalog @param {import('./state.js').Store} store */
export function pickers(catalog, store) {
  const ids = ['task', 'filter', 'episode', 'speed'];
  const [task, filter, episode, speed] = ids.map((id) => document.getElementById(id));
  const shown = catalog.tasks.filter((t) => t.filters.length && t.episodes.length);
  const current = () => shown.find((t) => t.name === store.state.task);
  fill(task, shown.map((t) => [t.name, t.name]));
  const showRecipe = recipes(document.getElementById('recipe'), document.getElementById('faults'), catalog, store);
  fill(speed, SPEEDS.map((s) => [s, `${s}×`]));
  const refill = () => {
    fill(filter, current().filters.map((f) => [f.name, f.name]));
    fill(episode, current().episodes.map((e) => [e.index, described(e)]));
  };
  task.addEventListener('change', () => {
    const { name, filters, episodes, map } = shown.find((t) => t.name === task.value);
    store.set({ task: name, filter: filters[0].name, episode: episodes[0].index, step: 0, angle: null, component: map.x });
  });
  filter.addEventListener('change', () => store.set({ filter: filter.value }));
  episode.addEventListener('change', () => store.set({ episode: Number(episode.value), step: 0, playing: false }));
  speed.addEventListener('change', () => store.set({ speed: Number(speed.value) }));
  const show = (state, changed = new Set(['task'])) => {
    if (changed.has('task')) refill();
    if (changed.has('task') || changed.has('recipe')) showRecipe();
    for (const select of [task, filter, episode, speed]) select.value = state[select.id];
  };
  show(store.state);
  store.listen(show);
}

function described({ index, policy, split, steps, contact_fraction }) {
  return `${index} · ${policy} · ${split} · ${steps} steps · contact ${percent(contact_fraction)}`;
}

function fill(select, options) {
  select.replaceChildren(...options.map(([value, text]) => new Option(text, value)));
  select.disabled = false;
}

/**
 * One choice of a few, as radio buttons in a row.
 * @param {HTMLElement} host @param {[string, string][]} options values and what they are called
 * @param {string} chosen @param {(value: string) => void} choose
 */
export function choice(host, options, chosen, choose) {
  host.hidden = options.length < 2;
  host.replaceChildren(
    ...options.map(([value, text]) => {
      const label = document.createElement('label');
      const input = document.createElement('input');
      Object.assign(input, { type: 'radio', name: host.id, value, checked: value === chosen });
      input.addEventListener('change', () => choose(value));
      label.append(input, text);
      return label;
    }),
  );
}
