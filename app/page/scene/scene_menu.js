/** The menu of the 3D scene: layers, colours, legend and viewpoints (docs/api.md). */

/** @import { State, Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */

import { SCENE_LAYERS, VIEWPOINTS } from '../core/constants.js';
import { create, createButton } from '../core/dom.js';
import { lineSample, swatch } from '../core/colours.js';
import { choice, choiceHost } from '../widgets/pickers.js';

/** @typedef {typeof SCENE_LAYERS[number]} SceneLayer */

/** @type {Record<SceneLayer, string>} */
const LABELS = {
  replay: 'Replay: robot and object',
  objects: 'Object, true and estimated',
  estimates: 'Position, true and estimated',
  contours: '2σ contours',
  particles: 'Particles',
  force: 'Contact force',
  map: 'Likelihood',
  camera: 'Camera and its image',
};
/** Options of layers: a key of the state, and the label. @type {Partial<Record<SceneLayer, [string, string][]>>} */
const LAYER_OPTIONS = {
  particles: [['tint', 'Colour of the particles']],
  map: [
    ['ground', 'Likelihood map'],
    ['height', 'Height of the map'],
  ],
};
const TINTS = { weight: 'by weight', share: 'by modality' };
const HEIGHTS = { floor: 'on the floor', belief: 'below the belief' };
/** @type {Record<typeof VIEWPOINTS[number], string>} */
const VIEWPOINT_LABELS = { first: 'initial', above: 'top', camera: 'camera' };
/** Keys of the state that the scene depends on. @type {(keyof State)[]} */
const STATE_KEYS = ['hide', 'ground', 'height', 'tint', 'scale', 'range', 'colours'];

export class SceneMenu {
  #store;
  /** @type {Map<SceneLayer, {row: HTMLElement, box: HTMLInputElement}>} */
  #rows = new Map();
  /** @type {Map<string, HTMLElement>} */
  #choices = new Map();
  /** @type {Map<string, HTMLButtonElement>} */
  #viewpoints = new Map();
  #legend = create('p', { id: 'scene-legend', ariaLabel: 'Legend of the scene' });
  /** @type {Trace | null} */
  #trace = null;

  /**
   * @param {HTMLElement} host of the scene
   * @param {Store} store
   * @param {(options: object) => void} setScene
   * @param {(at: string) => void} setViewpoint
   */
  constructor(host, store, setScene, setViewpoint) {
    this.#store = store;
    const button = create('button', {
      id: 'scene-layers',
      type: 'button',
      className: 'text',
      textContent: 'Layers…',
      title: 'Layers, colours and viewpoint of the scene',
      ariaHasPopup: 'dialog',
    });
    const menu = create('div', {
      id: 'scene-options',
      popover: 'auto',
      role: 'dialog',
      ariaLabel: 'Layers of the scene',
    });
    button.popoverTargetElement = menu;
    host.append(button, menu, this.#legend);
    menu.append(...SCENE_LAYERS.map((layer) => this.#row(layer)), this.#footer(setViewpoint));
    menu.addEventListener('beforetoggle', (event) => {
      if (/** @type {ToggleEvent} */ (event).newState !== 'open') return;
      const { bottom, left } = button.getBoundingClientRect();
      [menu.style.top, menu.style.left] = [`${bottom + 4}px`, `${left}px`];
    });
    store.when(STATE_KEYS, () => {
      this.#update();
      setScene(this.options);
    });
  }

  /** Options of the scene as the server receives them. */
  get options() {
    const { state } = this.#store;
    const { hide, ...options } = Object.fromEntries(STATE_KEYS.map((key) => [key, state[key]]));
    return { hidden: hiddenLayers(state.hide), ...options };
  }

  /** @param {Trace} trace */
  show(trace) {
    this.#trace = trace;
    this.#update();
  }

  #update() {
    const [trace, { state }] = [this.#trace, this.#store];
    if (!trace) return;
    const available = trace.header.scene ?? SCENE_LAYERS;
    for (const [layer, { row, box }] of this.#rows) {
      row.hidden = !available.includes(layer);
      box.checked = !hiddenLayers(state.hide).includes(layer);
    }
    this.#legend.replaceChildren(
      ...['truth', ...trace.sources].map((name) => legendEntry(swatch(name), trace.label(name))),
      ...(available.includes('force') && !hiddenLayers(state.hide).includes('force')
        ? [legendEntry(lineSample('--contact', [], 2.5), 'contact force')]
        : []),
    );
    for (const [at, button] of this.#viewpoints)
      button.hidden = at === 'camera' && !available.includes('camera');
    const maps = trace.fuses ? [...trace.modalities, 'fused'] : [];
    const ground = maps.includes(state.ground) ? state.ground : 'fused';
    this.#choose(
      'ground',
      maps.map((name) => [name, name]),
      ground,
    );
    this.#choose('height', HEIGHTS, state.height);
    this.#choose('tint', trace.has('effective_weights') ? TINTS : {}, state.tint);
  }

  /**
   * @param {'ground' | 'height' | 'tint'} key
   * @param {Parameters<typeof choice>[1]} options
   * @param {string} value
   */
  #choose(key, options, value) {
    const host = this.#choices.get(key);
    if (host) choice(host, options, value, (text) => this.#store.set({ [key]: text }));
  }

  /** @param {SceneLayer} layer */
  #row(layer) {
    const box = create('input', { type: 'checkbox', value: layer });
    box.addEventListener('change', () => {
      const others = hiddenLayers(this.#store.state.hide).filter((name) => name !== layer);
      this.#store.set({ hide: [...others, ...(box.checked ? [] : [layer])].join(',') });
    });
    const row = create('div', {}, create('label', {}, box, LABELS[layer]));
    if (layer === 'force')
      row.title = 'The arrow has a ring every few newtons, as its label states';
    for (const [key, label] of LAYER_OPTIONS[layer] ?? []) {
      const host = choiceHost(`scene-${key}`, label);
      this.#choices.set(key, host);
      row.append(host);
    }
    this.#rows.set(layer, { row, box });
    return row;
  }

  /** @param {(at: string) => void} setViewpoint */
  #footer(setViewpoint) {
    const row = create('div', { className: 'viewpoints' });
    row.append(create('span', { textContent: 'View' }));
    for (const at of VIEWPOINTS) {
      const button = createButton('', VIEWPOINT_LABELS[at], () => setViewpoint(at));
      this.#viewpoints.set(at, button);
      row.append(button);
    }
    return row;
  }
}

/**
 * @param {SVGElement} sample
 * @param {string} text
 */
const legendEntry = (sample, text) => create('span', { className: 'key' }, sample, text);

/**
 * Returns the hidden layers that the state names.
 * @param {string} hide
 * @returns {string[]}
 */
const hiddenLayers = (hide) => SCENE_LAYERS.filter((layer) => hide.split(',').includes(layer));
