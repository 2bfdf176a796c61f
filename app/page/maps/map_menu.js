/** The menu of the likelihood maps: display options, the pinned step and exports. */

/** @import { State, Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { MapPanel } from './map_panel.js' */

import { create, element, html, setOptions } from '../core/dom.js';
import { CHOICES } from '../core/state.js';
import { displayName } from '../core/units.js';
import { choice, choiceHost } from '../widgets/pickers.js';
import { bindExport } from './export_map.js';
import { mapPlane } from './map_choices.js';

const GAP = 6; // px between the menu and the panel

/** Label of each option and of its values. @type {Record<string, [label: string, values: Record<string, string>]>} */
const OPTIONS = {
  tiles: ['Steps', { one: 'current step', several: 'several' }],
  others: [
    'Other components',
    { auto: 'automatic', fixed: 'at the truth', marginal: 'integrated out' },
  ],
  scale: ['Scale', { normalised: 'relative to the peak', log: 'logarithm' }],
  range: ['Colour range', { own: 'per map', same: 'common' }],
  colours: ['Colour map', { viridis: 'viridis', cividis: 'cividis' }],
  zoom: ['Zoom', { fit: 'automatic', 1: 'full', 4: 'centre, 4 ×' }],
  axes: ['Axes', { offset: 'offset from truth', world: 'world' }],
  regions: ['50 and 95 % regions', { shown: 'visible', hidden: 'hidden' }],
  cloud: ['Particles', { hidden: 'hidden', shown: 'by weight' }],
};

/**
 * Fills the menu.
 * @param {HTMLElement} menu a popover
 * @param {HTMLElement} button that opens it
 * @param {Store} store
 * @param {MapPanel} maps
 * @returns {(trace: Trace) => void} adapts the menu to a trace
 */
export function mapMenu(menu, button, store, maps) {
  const rows = Object.fromEntries(Object.keys(OPTIONS).map((key) => [key, optionRow(key, store)]));
  const plane = create('select', { ariaLabel: 'Components of the axes' });
  const planeRow = create('label', {}, create('span', { textContent: 'Components' }), plane);
  plane.addEventListener('change', () => store.set({ plane: plane.value, angle: null }));
  html('.map-options', menu).append(planeRow, ...Object.values(rows));
  store.when(['plane'], ({ plane: names }) => names && (plane.value = names));
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
    for (const control of [pin, ...rows.cloud.querySelectorAll('input')]) control.disabled = tiled;
    rows.cloud.title = tiled ? 'Particles are drawn on the maps of the current step only' : '';
    pin.title = tiled
      ? 'Changes are shown on the maps of the current step only'
      : 'Show other maps relative to those of this step (m)';
  };
  restrict();
  store.when(['tiles', 'cloud'], restrict);
  menu.addEventListener('beforetoggle', (event) => {
    if (/** @type {ToggleEvent} */ (event).newState !== 'open') return;
    maps.showMeasures();
    const { top, left } = html('#maps').getBoundingClientRect(); // the maps stay visible
    [menu.style.top, menu.style.right] = [`${top}px`, `${innerWidth - left + GAP}px`];
    setLayers(maps.displayed[0]?.layers.map(({ name }) => name) ?? []);
  });
  return (trace) => {
    const isCurve = mapPlane(store.state, trace).length === 1;
    for (const key of ['tiles', 'range', 'colours', 'regions']) rows[key].hidden = isCurve;
    rows.cloud.hidden = !trace.has('effective_sample_size') || isCurve;
    rows.others.hidden = trace.components.length < 3;
    setOptions(plane, planeOptions(trace), mapPlane(store.state, trace).join());
    planeRow.hidden = plane.options.length < 2;
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
  return [map, ...others].map((pair) => [pair.join(), pair.map(displayName).join(', ')]);
}

/**
 * @param {string} key
 * @param {Store} store
 */
function optionRow(key, store) {
  const [label, labels] = OPTIONS[key];
  const host = choiceHost(`maps-${key}`, label);
  const options = CHOICES[key].map((value) => [value, labels[value]]);
  const show = (/** @type {State} */ state) =>
    choice(host, options, String(Object(state)[key]), (value) => store.set({ [key]: value }));
  show(store.state);
  store.when([/** @type {keyof State} */ (key)], show);
  return create('div', {}, create('span', { textContent: label }), host);
}
