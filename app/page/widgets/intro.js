/** The introduction of a first visit: what the page is about, examples to open, and a tour. */

/** @import { Store } from '../core/state.js' */
/** @import { Catalog } from '../types/server.js' */

import { create, createButton, html, openBelow } from '../core/dom.js';
import { parsePermalink } from '../core/state.js';
import { emptyNote } from './empty_note.js';

const STORAGE_KEY = 'beliefscope.intro';

export class Intro {
  #host;

  /**
   * @param {HTMLElement} host is shown if the address selects nothing, it was not closed before and there are examples
   * @param {Store} store
   * @param {() => void} startTour
   */
  constructor(host, store, startTour) {
    this.#host = host;
    const chips = store.catalog.examples.map((example) => {
      const open = () =>
        example.setup || store.set(parsePermalink(example.link, store.catalog).state);
      const chip = createButton('chip', example.title, open, { title: example.help });
      if (example.setup) openSetup(chip, example);
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

  /** `before_paint.js` sets the class before the first paint, so that the layout does not shift. */
  set #isShown(/** @type {boolean} */ isShown) {
    document.documentElement.classList.toggle('first-visit', isShown);
  }
}

/**
 * Lets a chip open what an example is about, and the command that serves its data.
 * @param {HTMLButtonElement} chip
 * @param {Catalog['examples'][number]} example
 */
function openSetup(chip, { title, help, setup }) {
  const box = create('div', { className: 'setup', popover: 'auto', role: 'dialog' });
  box.setAttribute('aria-label', title);
  box.append(
    ...emptyNote({
      title,
      paragraphs: [
        [help],
        ['The data set is not included. Download it and start the server with it.'],
      ],
      purpose: `With the files in the folder ${setup.split(' ').at(-1)}:`,
      commands: [setup],
    }),
  );
  document.body.append(box);
  chip.popoverTargetElement = box;
  chip.setAttribute('aria-haspopup', 'dialog');
  openBelow(box, chip);
}
