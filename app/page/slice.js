/** The angle at which the maps are cut: the true one, until somebody takes hold of the slider. */

import { fixed, signed, spoken, wrapped } from './units.js';

const REACH = 60; // degrees to either side of the episode's true angles

export class Slice {
  #label;
  #input;
  #button;
  #store;
  #trace = null;
  #angle = -1; // position in the state

  /** @param {HTMLElement} label with the slider inside @param {HTMLButtonElement} button back to the true angle
   *  @param {import('./state.js').Store} store */
  constructor(label, button, store) {
    [this.#label, this.#button, this.#store] = [label, button, store];
    this.#input = label.querySelector('input');
    this.#input.addEventListener('input', (event) => {
      store.set({ angle: this.#input.valueAsNumber / this.#scale }, { inputTime: event.timeStamp });
    });
    button.addEventListener('click', () => store.set({ angle: null }));
    store.listen((state, changed) => changed.has('angle') && this.move(state.step));
  }

  get #scale() {
    return this.#trace.shown(this.#angle).scale;
  }

  /** @param {import('./trace.js').Trace} trace */
  show(trace) {
    this.#trace = trace;
    this.#angle = trace.components.findIndex((_, i) => !trace.position.includes(i));
    this.#label.hidden = this.#button.hidden = this.#angle < 0;
    if (this.#angle < 0) return;
    const truth = trace.truth(this.#angle);
    const [low, high] = [Math.min(...truth), Math.max(...truth)];
    this.#input.min = String(Math.floor(low - REACH));
    this.#input.max = String(Math.ceil(high + REACH));
    this.#input.disabled = false;
    this.#label.querySelector('#slice-name').textContent = spoken(trace.components[this.#angle].name);
  }

  move(step) {
    if (!this.#trace || this.#angle < 0) return;
    const truth = this.#trace.truth(this.#angle)[step];
    const { angle } = this.#store.state;
    const shown = angle === null ? truth : angle * this.#scale;
    if (document.activeElement !== this.#input || angle === null) this.#input.value = String(shown);
    const { unit } = this.#trace.shown(this.#angle);
    const off = wrapped(shown - truth);
    this.#label.querySelector('output').textContent = angle === null ? `${fixed(shown)}${unit} true` : `${fixed(shown)}${unit}`;
    this.#label.title = angle === null ? 'The maps are cut at the true value' : `${signed(off)}${unit} from the true value`;
    this.#button.disabled = angle === null;
  }
}
