/** The introduction of a first visit: what the page is about, examples to open, and a tour. */

/** @import { Store } from '../core/state.js' */
/** @import { Catalog } from '../types/server.js' */

import { create, html } from '../core/dom.js';
import { parsePermalink } from '../core/state.js';

const STORAGE_KEY = 'beliefscope.intro';

export class Intro {
  #host;

  /**
   * @param {HTMLElement} host is shown if the address selects nothing, it was not closed before and there are examples
   * @param {Catalog} catalog
   * @param {Store} store
   * @param {() => void} startTour
   */
  constructor(host, catalog, store, startTour) {
    this.#host = host;
    const chips = catalog.examples.map(({ title, help, link }) => {
      const chip = create('button', { type: 'button', className: 'chip', title: help }, title);
      chip.addEventListener('click', () => store.set(parsePermalink(link, catalog).state));
      return chip;
    });
    if (!chips.length) this.#isShown = false;
    html('.examples', host).append(...chips);
    html('.start-tour', host).addEventListener('click', startTour);
    html('.close', host).addEventListener('click', () => {
      this.#isShown = false;
      localStorage.setItem(STORAGE_KEY, 'closed');
    });
  }

  /** Shows the introduction again. */
  show() {
    this.#isShown = true;
    localStorage.removeItem(STORAGE_KEY);
    html('.chip', this.#host).focus();
  }

  /** `early.js` sets the class before the first paint, so that the layout does not shift. */
  set #isShown(/** @type {boolean} */ isShown) {
    document.documentElement.classList.toggle('first-visit', isShown);
  }
}
