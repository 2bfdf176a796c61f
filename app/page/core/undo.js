/** Undo and redo of the selection, together with the step at that time. */

/** @import { State, Store } from './state.js' */

/** @type {(keyof State)[]} */
const SELECTION = [
  'task',
  'filter',
  'data',
  'episode',
  'faults',
  'against',
  'map',
  'plane',
  'others',
];
/** Restored together with the selection. @type {(keyof State)[]} */
const CURSOR = ['step', 'angle', 'component'];
const MAX_ENTRIES = 100;

export class Undo {
  /** @type {Store} */
  #store;
  /** @type {Partial<State>} */
  #current;
  /** @type {Partial<State>[]} */
  #past = [];
  /** @type {Partial<State>[]} */
  #future = [];
  #restoring = false;

  /** @param {Store} store */
  constructor(store) {
    this.#store = store;
    this.#current = this.#snapshot();
    store.listen((_, changed) => {
      if (!this.#restoring && SELECTION.some((key) => changed.has(key))) {
        this.#past = [...this.#past, this.#current].slice(-MAX_ENTRIES);
        this.#future = [];
      }
      this.#current = this.#snapshot();
    });
  }

  undo() {
    this.#restore(this.#past, this.#future);
  }

  redo() {
    this.#restore(this.#future, this.#past);
  }

  /** @returns {Partial<State>} */
  #snapshot() {
    const { state } = this.#store;
    return Object.fromEntries([...SELECTION, ...CURSOR].map((key) => [key, state[key]]));
  }

  /**
   * @param {Partial<State>[]} from
   * @param {Partial<State>[]} to
   */
  #restore(from, to) {
    this.#store.flush(); // adds pending changes to the history
    const entry = from.pop();
    if (!entry) return;
    to.push(this.#current);
    this.#restoring = true;
    this.#store.set({ ...entry, playing: false });
    this.#store.flush();
    this.#restoring = false;
  }
}
