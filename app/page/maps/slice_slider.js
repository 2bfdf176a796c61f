/** The angle at which the maps are cut: the true one, until somebody takes hold of the slider. */

import { fixed, signed, spoken, wrapped } from '../core/units.js';

const REACH = 60; // degrees to either side of the episode's true angles

export class Slice {
  #label;
  #input;
  #button;
  #store;
  #trace = null;
  #angle = -1; // position in the state

  /** @param {HTMLElement} label with the slider inside @param {HTMLButtonElement} button back to the true angle
   *  @param {import('../core/state.js').Store} store */
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

  /** (T,) where the maps are cut by themselves: at the truth, or where that is not known at the estimate. */
  get #around() {
    const estimate = this.#trace.mean('fused', this.#angle);
    return this.#trace.truth(this.#angle).map((v, t) => (Number.isFinite(v) ? v : estimate[t]));
  }

  /** @param {import('../data/trace.js').Trace} trace */
  show(trace) {
    this.#trace = trace;
    this.#angle = trace.components.findIndex((_, i) => !trace.position.includes(i));
    this.#label.hidden = this.#button.hidden = this.#angle < 0;
    if (this.#angle < 0) return;
    const around = this.#around.filter(Number.isFinite);
    const [low, high] = around.reduce(([least, most], v) => [Math.min(least, v), Math.max(most, v)], [Infinity, -Infinity]);
    this.#input.min = String(Math.floor(low - REACH));
    this.#input.max = String(Math.ceil(high + REACH));
    this.#input.disabled = false;
    this.#label.querySelector('#slice-name').textContent = spoken(trace.components[this.#angle].name);
  }

  move(step) {
    if (!this.#trace || this.#angle < 0) return;
    const truth = this.#around[step];
    const known = Number.isFinite(this.#trace.truth(this.#angle)[step]);
    const { angle } = this.#store.state;
    const shown = angle === null ? truth : angle * this.#scale;
    if (document.activeElement !== this.#input || angle === null) this.#input.value = String(shown);
    const { unit } = this.#trace.shown(this.#angle);
    const off = wrapped(shown - truth);
    this.#label.querySelector('output').textContent = angle === null ? `${fixed(shown)}${unit} ${known ? 'true' : 'est.'}` : `${fixed(shown)}${unit}`;
    this.#label.title = angle === null ? `The maps are cut at the ${known ? 'true' : 'estimated'} value` : `${signed(off)}${unit} from the ${known ? 'true' : 'estimated'} value`;
    this.#button.disabled = angle === null;
  }
}
