/** How the maps are shown, what lies on top of them, and the ways to take them along: a sheet behind one button. */

import { saving } from './export_map.js';
import { choice } from '../widgets/pickers.js';

/** Of the state: the question, and the answers with what they are called. */
const LOOKS = {
  scale: ['Colour', [['normalised', 'likelihood / peak'], ['log', 'log-likelihood']]],
  range: ['Peak and range', [['own', 'each its own'], ['same', 'of all maps']]],
  colours: ['Colour map', [['viridis', 'viridis'], ['cividis', 'cividis']]],
  zoom: ['Square', [['fit', 'as fits'], ['1', 'whole'], ['4', 'middle, 4 ×']]],
  axes: ['Axes', [['offset', 'offset from truth'], ['world', 'world']]],
  regions: ['50 and 95 % regions', [['shown', 'shown'], ['hidden', 'hidden']]],
  cloud: ['Particles', [['hidden', 'hidden'], ['shown', 'by weight']]],
};

/**
 * @param {HTMLElement} sheet a popover @param {HTMLElement} button that opens it
 * @param {import('../core/state.js').Store} store @param {import('./maps.js').Heatmaps} heatmaps
 * @returns {(trace: import('../data/trace.js').Trace) => void} for another trace
 */
export function mapTools(sheet, button, store, heatmaps) {
  const rows = sheet.querySelector('.looks');
  const hosts = Object.entries(LOOKS).map(([key, [question]]) => {
    const [row, name, host] = ['div', 'span', 'div'].map((tag) => document.createElement(tag));
    name.textContent = question;
    Object.assign(host, { id: `maps-${key}`, className: 'choice' });
    host.setAttribute('role', 'radiogroup');
    host.setAttribute('aria-label', question);
    row.append(name, host);
    rows.append(row);
    return [key, row, host];
  });
  const show = () => {
    for (const [key, , host] of hosts) choice(host, LOOKS[key][1], store.state[key], (value) => store.set({ [key]: value }));
  };
  show();
  store.listen((state, changed) => {
    for (const [key, , host] of hosts) {
      if (changed.has(key)) for (const input of host.querySelectorAll('input')) input.checked = input.value === state[key];
    }
  });
  const pin = sheet.querySelector('.pin');
  pin.addEventListener('click', () => heatmaps.pin());
  heatmaps.changed = () => (pin.textContent = heatmaps.pinned ? `Let step ${heatmaps.pinned.maps.step} go` : 'Show change from this step');
  const fill = saving(sheet.querySelector('.save'), () => heatmaps.shown);
  sheet.addEventListener('beforetoggle', ({ newState }) => {
    if (newState !== 'open') return;
    // Beside the maps, so that they can be seen.
    const { top, left } = button.closest('.panel').getBoundingClientRect();
    [sheet.style.top, sheet.style.right] = [`${top}px`, `${innerWidth - left + 6}px`];
    fill(heatmaps.shown.figures.map(({ name }) => name));
  });
  return (trace) => {
    for (const [key, row] of hosts) if (key === 'cloud') row.hidden = trace.header.kind !== 'pf';
  };
}
