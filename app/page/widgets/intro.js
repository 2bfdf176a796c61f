/** The introduction of a first visit: the outage of the displayed run in words, and examples to open. */

/** @import { Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { Catalog } from '../types/server.js' */

import { create, html } from '../core/dom.js';
import { parsePermalink } from '../core/state.js';
import { outageFinding } from '../step/finding.js';

export class Intro {
  #host;
  #store;
  #help = ''; // of the example that was opened last

  /**
   * @param {HTMLElement} host is shown if the address selects nothing and there are examples
   * @param {Catalog} catalog
   * @param {Store} store
   */
  constructor(host, catalog, store) {
    this.#host = host;
    this.#store = store;
    const chips = catalog.examples.map(({ title, help, link }) => {
      const chip = create('button', { type: 'button', className: 'chip', title: help }, title);
      chip.addEventListener('click', () => {
        this.#help = help;
        store.set(parsePermalink(link, catalog).state);
      });
      return chip;
    });
    host.hidden = Boolean(location.search) || !chips.length;
    html('.examples', host).append(...chips);
    html('.close', host).addEventListener('click', () => (host.hidden = true));
  }

  /** @param {Trace} trace */
  show(trace) {
    if (this.#host.hidden) return;
    const { component } = this.#store.state;
    const index = trace.components.findIndex(({ name }) => name === component);
    html('.finding', this.#host).textContent = outageFinding(trace, index) || this.#help;
  }
}
