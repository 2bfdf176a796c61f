/** Separators between the panels: dragged, moved with arrow keys, and remembered. */

/** @import { Pane, Sizes } from './pane_sizes.js' */

import { html } from './dom.js';
import { LIMITS, parseSizes, permittedShare, shareAfterKey } from './pane_sizes.js';

const STORAGE_KEY = 'beliefscope.sizes'; // also in before_paint.js

/** The space that each pane divides with its neighbour, and the pane. @type {Record<Pane, [space: string, pane: string]>} */
const PARTS = {
  side: ['main', '#maps'],
  timeline: ['body', '#timeline'],
  step: ['main', '#step'],
};
const PANES = /** @type {Pane[]} */ (Object.keys(PARTS));

export class Splitters {
  #sizes = parseSizes(localStorage.getItem(STORAGE_KEY));
  /** Shares before a pane was collapsed. @type {Sizes} */
  #before = {};

  constructor() {
    for (const pane of PANES) this.#bind(pane);
    this.set(this.#sizes);
    new ResizeObserver(() => this.#describe()).observe(html('main'));
  }

  /** @param {Sizes} sizes of all panes; a pane without a size has its default */
  set(sizes) {
    const { classList, style } = document.documentElement;
    this.#sizes = { ...sizes };
    for (const pane of PANES) {
      const share = sizes[pane];
      classList.toggle(`sized-${pane}`, share !== undefined);
      classList.toggle(`collapsed-${pane}`, share === 0);
      style.setProperty(`--${pane}-share`, share === undefined ? '' : String(share));
    }
    localStorage.setItem(STORAGE_KEY, JSON.stringify(this.#sizes));
    this.#describe();
  }

  /** @param {Pane} pane */
  #bind(pane) {
    const bar = separator(pane);
    const isVertical = bar.ariaOrientation === 'vertical';
    bar.addEventListener('pointerdown', (event) => {
      if (event.button) return;
      bar.setPointerCapture(event.pointerId);
      event.preventDefault();
      bar.focus();
    });
    bar.addEventListener('pointermove', (event) => {
      if (!bar.hasPointerCapture(event.pointerId)) return;
      const { right, bottom, width, height } = spaceOf(pane);
      const share = isVertical
        ? (right - event.clientX) / width
        : (bottom - event.clientY) / height;
      this.#resize(pane, permittedShare(pane, share));
    });
    bar.addEventListener('dblclick', () => this.#resize(pane, undefined));
    bar.addEventListener('keydown', (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const share = this.#share(pane);
      const next =
        event.key === 'Enter'
          ? this.#toggled(pane, share)
          : shareAfterKey(pane, share, event.key, isVertical, event.shiftKey);
      if (next === null) return;
      event.preventDefault();
      event.stopPropagation(); // the arrow keys move the cursor elsewhere
      this.#resize(pane, next);
    });
  }

  /**
   * @param {Pane} pane
   * @param {number | undefined} share undefined for the default
   */
  #resize(pane, share) {
    const { [pane]: _, ...others } = this.#sizes;
    this.set(share === undefined ? others : { ...others, [pane]: share });
  }

  /**
   * @param {Pane} pane
   * @param {number} share
   */
  #toggled(pane, share) {
    if (share) this.#before[pane] = this.#sizes[pane];
    return share ? 0 : this.#before[pane];
  }

  /**
   * The displayed share of a pane.
   * @param {Pane} pane
   */
  #share(pane) {
    const rect = html(PARTS[pane][1]).getBoundingClientRect();
    const space = spaceOf(pane);
    return pane === 'side' ? rect.width / space.width : rect.height / space.height;
  }

  /** Updates the values for screen readers. */
  #describe() {
    for (const pane of PANES) {
      const share = this.#share(pane);
      const [, max] = LIMITS[pane];
      const bar = separator(pane);
      [bar.ariaValueMin, bar.ariaValueMax] = ['0', String(100 * max)];
      bar.ariaValueNow = String(Math.min(Math.round(100 * share), 100 * max));
    }
  }
}

/** @param {Pane} pane */
const separator = (pane) => html(`#split-${pane}`);

/** @param {Pane} pane */
const spaceOf = (pane) => html(PARTS[pane][0]).getBoundingClientRect();
