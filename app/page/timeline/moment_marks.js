/** Moments that somebody points out, as triangles above the tracks: a click goes there. */

/**
 * @typedef {object} Moment
 * @property {number} step @property {string} label what is the matter there, with its value and unit
 * @property {string} [measure] that found it: error, NEES …
 */

export class Marks {
  #host;
  #store;
  #buttons = [];

  /** @param {HTMLElement} host @param {import('../core/state.js').Store} store */
  constructor(host, store) {
    [this.#host, this.#store] = [host, store];
    host.addEventListener('keydown', (event) => this.#walk(event));
  }

  /** @param {Moment[]} moments in place of those that were there before */
  set(moments) {
    const ordered = [...moments].sort((a, b) => a.step - b.step);
    this.#buttons = ordered.map((moment) => this.#button(moment));
    this.#host.replaceChildren(...this.#buttons.map(({ button }) => button));
    this.#host.hidden = !moments.length;
  }

  /** @param {(step: number) => number | null} x px of a step, null where it is out of sight @param {number} width px that there are */
  place(x, width) {
    for (const { step, button } of this.#buttons) {
      const at = x(step);
      button.hidden = at === null;
      button.style.transform = `translateX(${(at ?? 0).toFixed(2)}px)`;
      button.classList.toggle('leftward', at > width / 2);
    }
    if (!this.#seen.some((button) => button.tabIndex === 0)) this.#stopAt(this.#seen[0]);
  }

  /** Shows which of them the cursor is at. */
  move(step) {
    for (const mark of this.#buttons) {
      if (mark.here === (mark.step === step)) continue;
      mark.here = !mark.here;
      mark.button.ariaCurrent = mark.here ? 'true' : null;
    }
  }

  #button({ step, label, measure }) {
    const button = document.createElement('button');
    button.type = 'button';
    button.tabIndex = -1;
    button.setAttribute('aria-label', `Step ${step}: ${measure && !label.startsWith(measure) ? `${measure}, ` : ''}${label}`);
    button.addEventListener('pointerdown', (event) => event.stopPropagation()); // it is no scrub
    button.addEventListener('click', (event) => {
      this.#store.set({ step, playing: false }, { inputTime: event.timeStamp });
      if (event.detail) button.blur(); // who came with the mouse goes on with the page's keys
    });
    return { step, button, here: false };
  }

  /** One stop of the tab key for all; the arrows go from one to the next. */
  #walk(event) {
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    const seen = this.#seen;
    const place = seen.indexOf(document.activeElement);
    if (!by || place < 0) return;
    event.preventDefault();
    event.stopPropagation();
    const next = seen[Math.min(Math.max(place + by, 0), seen.length - 1)];
    this.#stopAt(next);
    next.focus();
  }

  get #seen() {
    return this.#buttons.map(({ button }) => button).filter((button) => !button.hidden);
  }

  #stopAt(stop) {
    for (const { button } of this.#buttons) button.tabIndex = button === stop ? 0 : -1;
  }
}
