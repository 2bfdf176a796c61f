/** Marks of events, as ticks in the overview of the episode. A click moves the cursor there. */

/** @import { Store } from '../core/state.js' */

import { createButton } from '../core/dom.js';
import { stepLabel } from '../core/units.js';

/**
 * @typedef {object} EventMark
 * @property {number} step
 * @property {number | null} time s; null without timestamps
 * @property {string} label description with a value and its unit
 * @property {string} [measure] that selected the event: error, NEES …
 *
 * @typedef {{step: number, button: HTMLButtonElement, current: boolean}} Mark
 */

export class EventMarks {
  #host;
  #store;
  /** @type {Mark[]} */
  #marks = [];

  /**
   * @param {HTMLElement} host
   * @param {Store} store
   */
  constructor(host, store) {
    this.#host = host;
    this.#store = store;
    host.addEventListener('keydown', (event) => this.#moveFocus(event));
  }

  /**
   * Replaces the marks.
   * @param {EventMark[]} events
   */
  set(events) {
    const sorted = [...events].sort((a, b) => a.step - b.step);
    this.#marks = sorted.map((event) => this.#mark(event));
    this.#host.replaceChildren(...this.#marks.map(({ button }) => button));
    this.#host.hidden = !events.length;
  }

  /**
   * Places the marks horizontally.
   * @param {(step: number) => number} x px
   * @param {number} width px
   */
  place(x, width) {
    for (const { step, button } of this.#marks) {
      const position = x(step);
      button.style.transform = `translateX(${position.toFixed(2)}px)`;
      button.classList.toggle('leftward', position > width / 2);
    }
    if (!this.#marks.some(({ button }) => button.tabIndex === 0))
      this.#setTabStop(this.#marks[0]?.button);
  }

  /**
   * Highlights the mark at the cursor.
   * @param {number} step
   */
  move(step) {
    for (const mark of this.#marks) {
      const current = mark.step === step;
      if (mark.current === current) continue;
      mark.current = current;
      mark.button.ariaCurrent = current ? 'true' : null;
    }
  }

  /**
   * @param {EventMark} event
   * @returns {Mark}
   */
  #mark({ step, time, label, measure }) {
    const name = stepLabel(step, time);
    const prefix = measure && !label.startsWith(measure) ? `${measure}, ` : '';
    const press = (/** @type {MouseEvent} */ event) => {
      this.#store.set({ step, playing: false }, { inputTime: event.timeStamp });
      if (event.detail) button.blur(); // after a mouse click the page's keys work again
    };
    const button = createButton('', '', press, {
      tabIndex: -1,
      ariaLabel: `${name[0].toUpperCase()}${name.slice(1)}: ${prefix}${label}`,
    });
    button.addEventListener('pointerdown', (event) => event.stopPropagation()); // no scrubbing
    return { step, button, current: false };
  }

  /**
   * Moves the focus with the arrow keys. The tab key stops at one mark only.
   * @param {KeyboardEvent} event
   */
  #moveFocus(event) {
    const direction = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    const buttons = this.#marks.map(({ button }) => button);
    const index = buttons.findIndex((button) => button === document.activeElement);
    if (!direction || index < 0) return;
    event.preventDefault();
    event.stopPropagation();
    const next = buttons[Math.min(Math.max(index + direction, 0), buttons.length - 1)];
    this.#setTabStop(next);
    next.focus();
  }

  /** @param {HTMLButtonElement | undefined} target */
  #setTabStop(target) {
    for (const { button } of this.#marks) button.tabIndex = button === target ? 0 : -1;
  }
}
