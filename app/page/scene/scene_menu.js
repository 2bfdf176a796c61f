/** What the 3D scene shows: a sheet of its layers, with the legend, and the places to look from (docs/api.md). */

import { sample, swatch } from '../core/palette.js';
import { choice } from '../widgets/pickers.js';

const LAYERS = ['replay', 'objects', 'estimates', 'contours', 'particles', 'force', 'map', 'camera'];
const PLACES = [['first', 'at first'], ['above', 'from above'], ['camera', 'at camera']];
/** Of the state: the answers to each choice, and what they are called. */
const CHOICES = {
  tint: [['weight', 'by weight'], ['share', 'by modality']],
  height: [['floor', 'on the floor'], ['belief', 'under the belief']],
};
/** Parts of the state that make up a look. */
const PARTS = ['hide', 'ground', 'height', 'tint', 'scale', 'range', 'colours'];

export class SceneLook {
  #store;
  #rows = {};
  #choices = {};
  #places = {};
  #legend = element('p', { className: 'swatches' });
  #trace = null;

  /**
   * @param {HTMLElement} host of the scene @param {import('../core/state.js').Store} store
   * @param {(look: object) => void} tell the server @param {(at: string) => void} stand elsewhere in the scene
   */
  constructor(host, store, tell, stand) {
    this.#store = store;
    const button = element('button', { id: 'scene-layers', type: 'button', className: 'text', textContent: 'Layers…', title: 'What the scene shows, in which colours, and from where' });
    const sheet = element('div', { id: 'scene-options', popover: 'auto' });
    sheet.setAttribute('role', 'dialog');
    sheet.setAttribute('aria-label', 'Layers of the scene');
    button.popoverTargetElement = sheet;
    button.setAttribute('aria-haspopup', 'dialog');
    host.append(button, sheet);
    sheet.append(...LAYERS.map((layer) => this.#row(layer)), this.#legend, this.#footer(stand));
    sheet.addEventListener('beforetoggle', ({ newState }) => {
      if (newState !== 'open') return;
      const { bottom, left } = button.getBoundingClientRect();
      [sheet.style.top, sheet.style.left] = [`${bottom + 4}px`, `${left}px`];
    });
    store.listen((_, changed) => {
      if (!PARTS.some((part) => changed.has(part))) return;
      this.#draw();
      tell(this.look);
    });
  }

  /** As the server is told it. */
  get look() {
    const { hide, ...look } = Object.fromEntries(PARTS.map((part) => [part, this.#store.state[part]]));
    return { hidden: hidden(hide), ...look };
  }

  /** @param {import('../data/trace.js').Trace} trace whose layers there are */
  show(trace) {
    this.#trace = trace;
    this.#draw();
  }

  #draw() {
    const [trace, { state }] = [this.#trace, this.#store];
    if (!trace) return;
    const there = trace.header.scene ?? LAYERS;
    for (const layer of LAYERS) {
      const { row, box } = this.#rows[layer];
      row.hidden = !there.includes(layer);
      box.checked = !hidden(state.hide).includes(layer);
    }
    this.#legend.replaceChildren(...['truth', ...trace.sources].map((name) => keyed(swatch(name), trace.called(name))));
    for (const [at, button] of Object.entries(this.#places)) button.hidden = at === 'camera' && !there.includes('camera');
    const layers = trace.fuses ? [...trace.modalities, 'fused'] : [];
    const ground = layers.includes(state.ground) ? state.ground : 'fused';
    const set = (name) => (value) => this.#store.set({ [name]: value });
    choice(this.#choices.ground, layers.map((name) => [name, name]), ground, set('ground'));
    choice(this.#choices.height, CHOICES.height, state.height, set('height'));
    choice(this.#choices.tint, trace.has('acting') ? CHOICES.tint : [], state.tint, set('tint'));
  }

  #row(layer) {
    const [row, label] = ['div', 'label'].map((tag) => element(tag));
    const box = element('input', { type: 'checkbox', value: layer });
    box.addEventListener('change', () => {
      const others = hidden(this.#store.state.hide).filter((one) => one !== layer);
      this.#store.set({ hide: [...others, ...(box.checked ? [] : [layer])].join(',') });
    });
    label.append(box, NAMES[layer]);
    row.append(label);
    if (layer === 'force') row.append(keyed(sample('--contact', [], 2.5), '4 cm for 10 N'));
    for (const [name, question] of QUESTIONS[layer] ?? []) {
      const host = (this.#choices[name] = element('div', { id: `scene-${name}`, className: 'choice' }));
      host.setAttribute('role', 'radiogroup');
      host.setAttribute('aria-label', question);
      row.append(host);
    }
    this.#rows[layer] = { row, box };
    return row;
  }

  #footer(stand) {
    const row = element('div', { className: 'places' });
    for (const [at, text] of PLACES) {
      const button = (this.#places[at] = element('button', { type: 'button', textContent: text }));
      button.addEventListener('click', () => stand(at));
      row.append(button);
    }
    row.prepend(element('span', { textContent: 'Look' }));
    return row;
  }
}

const NAMES = {
  replay: 'Replay: robot and object', objects: 'Object, true and estimated', estimates: 'Position, true and estimated', contours: '2σ contours',
  particles: 'Particles', force: 'Force in contact', map: 'Likelihood', camera: 'Camera and its picture',
};
/** What can be chosen of a layer: a part of the state, and the question. */
const QUESTIONS = {
  particles: [['tint', 'What the colour of particles tells']],
  map: [['ground', 'Which map lies there'], ['height', 'Where it lies']],
};

const element = (tag, properties = {}) => Object.assign(document.createElement(tag), properties);

/** A line as it is drawn, and what it means. */
function keyed(sample, text) {
  const key = element('span', { className: 'key' });
  key.append(sample, text);
  return key;
}

/** @param {string} hide of the state @returns {string[]} the layers that are hidden */
const hidden = (hide) => hide.split(',').filter((layer) => LAYERS.includes(layer));
