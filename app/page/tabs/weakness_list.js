/** List of the weaknesses of a filter; a fine-tuning run addresses the selected one. */

/** @import { Store } from '../core/state.js' */
/** @import { Weakness } from '../types/server.js' */

import { create, createButton, html } from '../core/dom.js';
import { typeset } from '../core/units.js';

export class WeaknessList {
  #host;
  #store;
  #choose;

  /**
   * @param {HTMLElement} host
   * @param {Store} store
   * @param {(settings: Weakness['settings']) => void} choose called with the settings of the selected weakness
   */
  constructor(host, store, choose) {
    this.#host = host;
    this.#store = store;
    this.#choose = choose;
  }

  /** @param {Weakness[]} weaknesses the first is selected */
  show(weaknesses) {
    html('.list', this.#host).replaceChildren(...weaknesses.map((item, i) => this.#item(item, i)));
    html('.none', this.#host).hidden = weaknesses.length > 0;
  }

  /**
   * @param {Weakness} weakness
   * @param {number} i
   */
  #item({ title, evidence, episode, step, settings }, i) {
    const input = create('input', { type: 'radio', name: 'weakness', checked: !i });
    input.addEventListener('change', () => this.#choose(settings));
    const item = create(
      'div',
      { className: 'item' },
      create('label', {}, input, create('strong', { textContent: title })),
      create('p', { textContent: typeset(evidence) }),
    );
    if (episode !== null) {
      const text = step === null ? `episode ${episode}` : `episode ${episode}, step ${step}`;
      const open = () =>
        this.#store.set({ episode, step: step ?? 0, tab: 'diagnosis', playing: false });
      item.append(createButton('text quiet', text, open, { title: 'Show this step' }));
    }
    return item;
  }
}
