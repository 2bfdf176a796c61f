/** Choice of the group of steps that the timeline shades: contact, or a group of another covariate. */

import { element, html } from '../core/dom.js';

export class GroupPicker {
  #key = html('#group-key');
  #name = html('span', this.#key);
  #select = element('#group', HTMLSelectElement);

  /** @param {() => void} onChange */
  constructor(onChange) {
    this.#select.addEventListener('change', onChange);
  }

  /** Name of the chosen group; empty if there is none. */
  get value() {
    return this.#select.value;
  }

  /**
   * Offers the groups of a trace; a single one needs no choice.
   * @param {string[]} groups
   */
  show(groups) {
    const chosen = this.value;
    this.#select.replaceChildren(...groups.map((name) => new Option(name)));
    if (groups.includes(chosen)) this.#select.value = chosen;
    this.#key.hidden = !groups.length;
    this.#select.hidden = groups.length < 2;
    this.#name.textContent = groups.length === 1 ? groups[0] : '';
  }
}
