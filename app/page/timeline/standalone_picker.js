/** The timeline's choice of a standalone filter: the same filter with one modality only, as comparison run. */

/** @import { Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */

import { element } from '../core/dom.js';
import { displayName } from '../core/units.js';

const PREFIX = 'only=';

export class StandalonePicker {
  #select = element('#standalone', HTMLSelectElement);
  #store;

  /** @param {Store} store */
  constructor(store) {
    this.#store = store;
    this.#select.addEventListener('change', () => {
      const { value } = this.#select;
      store.set({ against: value && PREFIX + value });
    });
    store.when(['against'], () => this.#update());
  }

  /** @param {Trace} trace */
  show({ inputs }) {
    this.#select.hidden = !inputs.length;
    this.#select.replaceChildren(
      new Option('no standalone', ''),
      ...inputs.map((name) => new Option(`${displayName(name)} standalone`, name)),
    );
    this.#update();
  }

  #update() {
    const { against } = this.#store.state;
    this.#select.value = against.startsWith(PREFIX) ? against.slice(PREFIX.length) : '';
  }
}
