/** Maps to which the displayed ones are compared: those of a pinned step, or of the comparison run. */

/** @import { Store } from '../core/state.js' */
/** @import { Selection } from '../types/server.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { Cursor } from '../data/view_socket.js' */
/** @import { Maps } from './map_values.js' */

import { mapChoices } from './map_choices.js';
import { formatPin, parsePin } from './pinned_step.js';

/**
 * @typedef {{maps: Maps, selection: Selection}} Pinned
 * @typedef {{maps: Maps, name: string, selection: Selection | null}} Reference selection: null for the comparison run
 */

export class References {
  /** Maps of the pinned step. @type {Pinned | null} */
  pinned = null;
  #store;
  #requestMaps;
  #changed;
  #requested = '';
  /** @type {{maps: Maps, trace: Trace, comparisonName: string} | null} */
  #displayed = null;

  /**
   * @param {Store} store
   * @param {(cursor: Cursor) => Promise<Maps | null>} requestMaps
   * @param {() => void} changed called when maps were pinned or released
   */
  constructor(store, requestMaps, changed) {
    this.#store = store;
    this.#requestMaps = requestMaps;
    this.#changed = changed;
  }

  /** The reference of the displayed maps. @returns {Reference | null} */
  get current() {
    if (this.pinned) return { ...this.pinned, name: `step ${this.pinned.maps.step}` };
    const maps = this.#displayed?.maps;
    if (!maps?.beside || !comparable(maps.beside, maps)) return null;
    return { maps: maps.beside, name: this.#displayed?.comparisonName ?? '', selection: null };
  }

  /**
   * Follows the displayed maps: the pinned ones are requested again for another quantity or other axes, and released
   * where they cannot be compared.
   * @param {Maps} maps
   * @param {Trace} trace
   * @param {string} comparisonName label of the comparison run
   */
  follow(maps, trace, comparisonName) {
    this.#displayed = { maps, trace, comparisonName };
    const pinned = this.pinned;
    if (pinned && content(pinned.maps) !== content(maps))
      [this.pinned, this.#requested] = [null, ''];
    else if (
      pinned &&
      (pinned.selection.task !== trace.selection.task || !comparable(pinned.maps, maps))
    )
      this.toggle();
    this.restore();
  }

  /** Pins the displayed maps, or releases the pinned ones. */
  toggle() {
    if (!this.#displayed) return;
    const { maps, trace } = this.#displayed;
    const { selection } = trace;
    this.#set(this.pinned ? null : { maps, selection });
    const pin = this.pinned ? formatPin(selection, maps.step, this.#store.state.angle) : '';
    this.#store.set({ pin });
  }

  /** Follows the state: requests the maps of a pinned step that a link names, or releases them. */
  async restore() {
    const { pin, task } = this.#store.state;
    if (!pin && this.pinned) this.#set(null);
    if (!pin || !this.#displayed || this.pinned || this.#requested === pin) return;
    this.#requested = pin;
    const { selection, step, angle } = parsePin(pin, task);
    const contentKey = content(this.#displayed.maps);
    const choices = mapChoices(this.#store.state, this.#displayed.trace);
    const maps = await this.#requestMaps({ ...selection, step, angle, ...choices });
    const displayed = this.#displayed.maps;
    if (!maps || this.#store.state.pin !== pin || this.pinned || contentKey !== content(displayed))
      return;
    if (comparable(maps, displayed)) this.#set({ maps, selection });
    else this.#store.set({ pin: '' });
  }

  /** @param {Pinned | null} pinned */
  #set(pinned) {
    this.pinned = pinned;
    this.#changed();
  }
}

/**
 * Identifies the quantity, the axes and the treatment of the other components of maps.
 * @param {Pick<Maps, 'quantity' | 'axes' | 'others'>} maps
 */
export const content = ({ quantity, axes, others }) =>
  [quantity, others, ...axes.map(({ name }) => name)].join();

/**
 * Returns whether maps have the same layers, content and extent.
 * @param {Pick<Maps, 'quantity' | 'axes' | 'others' | 'layers'>} a
 * @param {Pick<Maps, 'quantity' | 'axes' | 'others' | 'layers'>} b
 */
export const comparable = (a, b) =>
  a.layers.join() === b.layers.join() &&
  content(a) === content(b) &&
  a.axes.every(({ half_width: half }, i) => Math.abs(half / b.axes[i].half_width - 1) < 1e-5);
