/** The menu of the likelihood maps: display options, the pinned step and exports. */

/** @import { State, Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { MapPanel } from './map_panel.js' */

import { create, element, html } from '../core/dom.js';
import { displayName } from '../core/units.js';
import { choice } from '../widgets/pickers.js';
import { bindExport } from './export_map.js';
import { mapPlane } from './map_choices.js';

const GAP = 6; // px between the menu and the panel

/** @type {{key: keyof State, label: string, options: [value: string, label: string][]}[]} */
const OPTIONS = [
  {
    key: 'tiles',
    label: 'Steps',
    options: [
      ['one', 'current step'],
      ['several', 'several'],
    ],
  },
  {
    key: 'others',
    label: 'Other components',
    options: [
      ['auto', 'automatic'],
      ['fixed', 'at the truth'],
      ['marginal', 'integrated out'],
    ],
  },
  {
    key: 'scale',
    label: 'Scale',
    options: [
      ['normalised', 'relative to the peak'],
      ['log', 'logarithm'],
    ],
  },
  {
    key: 'range',
    label: 'Colour range',
    options: [
      ['own', 'per map'],
      ['same', 'common'],
    ],
  },
  {
    key: 'colours',
    label: 'Colour map',
    options: [
      ['viridis', 'viridis'],
      ['cividis', 'cividis'],
    ],
  },
  {
    key: 'zoom',
    label: 'Zoom',
    options: [
      ['fit', 'automatic'],
      ['1', 'full'],
      ['4', 'centre, 4 ×'],
    ],
  },
  {
    key: 'axes',
    label: 'Axes',
    options: [
      ['offset', 'offset from truth'],
      ['world', 'world'],
    ],
  },
  {
    key: 'regions',
    label: '50 and 95 % regions',
    options: [
      ['shown', 'visible'],
      ['hidden', 'hidden'],
    ],
  },
  {
    key: 'cloud',
    label: 'Particles',
    options: [
      ['hidden', 'hidden'],
      ['shown', 'by weight'],
    ],
  },
];

/**
 * Fills the menu.
 * @param {HTMLElement} menu a popover
 * @param {HTMLElement} button that opens it
 * @param {Store} store
 * @param {MapPanel} maps
 * @returns {(trace: Trace) => void} adapts the menu to a trace
 */
export function mapMenu(menu, button, store, maps) {
  const rows = OPTIONS.map((option) => optionRow(option, store));
  const plane = create('select', { ariaLabel: 'Components of the axes' });
  const planeRow = create('label', {}, create('span', { textContent: 'Components' }), plane);
  plane.addEventListener('change', () => store.set({ plane: plane.value, angle: null }));
  html('.map-options', menu).append(planeRow, ...rows);
  store.listen(({ plane: names }, changed) => {
    if (changed.has('plane') && names) plane.value = names;
  });
  const pin = element('.pin', HTMLButtonElement, menu);
  pin.addEventListener('click', () => maps.togglePin());
  maps.changed = () => {
    pin.textContent = maps.pinned
      ? `Unpin step ${maps.pinned.maps.step}`
      : 'Show change from this step';
  };
  const setLayers = bindExport(html('.export', menu), () => maps.displayed);
  const restrict = () => {
    const tiled = store.state.tiles === 'several';
    const cloud = rows[OPTIONS.findIndex(({ key }) => key === 'cloud')];
    for (const control of [pin, ...cloud.querySelectorAll('input')]) control.disabled = tiled;
    cloud.title = tiled ? 'Particles are drawn on the maps of the current step only' : '';
    pin.title = tiled
      ? 'Changes are shown on the maps of the current step only'
      : 'Show other maps relative to those of this step (m)';
  };
  restrict();
  store.listen((_, changed) => {
    if (changed.has('tiles') || changed.has('cloud')) restrict();
  });
  menu.addEventListener('beforetoggle', (event) => {
    if (/** @type {ToggleEvent} */ (event).newState !== 'open') return;
    maps.showMeasures();
    const { top, left } = html('#maps').getBoundingClientRect(); // the maps stay visible
    [menu.style.top, menu.style.right] = [`${top}px`, `${innerWidth - left + GAP}px`];
    setLayers(maps.displayed[0]?.layers.map(({ name }) => name) ?? []);
  });
  return (trace) => {
    const isCurve = mapPlane(store.state, trace).length === 1;
    OPTIONS.forEach(({ key }, i) => {
      if (key === 'cloud') rows[i].hidden = !trace.has('effective_sample_size') || isCurve;
      if (['tiles', 'range', 'colours', 'regions'].includes(key)) rows[i].hidden = isCurve;
      if (key === 'others') rows[i].hidden = trace.components.length < 3;
    });
    plane.replaceChildren(...planeOptions(trace));
    planeRow.hidden = plane.options.length < 2;
    plane.value = mapPlane(store.state, trace).join();
  };
}

/**
 * Returns an option for each pair of components, the pair of the task's map first.
 * @param {Trace} trace
 */
function planeOptions({ components, task }) {
  const pairs = components.flatMap(({ name }, i) =>
    components.slice(i + 1).map((other) => [name, other.name]),
  );
  const map = task.map.components;
  const others = pairs.filter(
    (pair) => pair.join() !== map.join() && [...pair].reverse().join() !== map.join(),
  );
  return [map, ...others].map((pair) => new Option(pair.map(displayName).join(', '), pair.join()));
}

/**
 * @param {typeof OPTIONS[number]} option
 * @param {Store} store
 */
function optionRow({ key, label, options }, store) {
  const host = create('div', {
    id: `maps-${key}`,
    className: 'choice',
    role: 'radiogroup',
    ariaLabel: label,
  });
  const show = () =>
    choice(host, options, String(store.state[key]), (value) => store.set({ [key]: value }));
  show();
  store.listen((_, changed) => {
    if (changed.has(key)) show();
  });
  return create('div', {}, create('span', { textContent: label }), host);
}
