/** Heights of the charts that the user has chosen, as shares; separators between the charts change them. */

import { create } from '../core/dom.js';
import { sum } from '../data/arrays.js';

const STORAGE_KEY = 'beliefscope.charts';
const MIN_HEIGHT = 28; // px
const KEY_STEP = 10; // px

/**
 * Moves the border below a chart; the chart below it gives or gets the difference.
 * @param {readonly number[]} heights px
 * @param {number} index of the chart
 * @param {number} change px
 * @param {number} [min] px
 */
export function withMovedBorder(heights, index, change, min = MIN_HEIGHT) {
  const [upper, lower] = [heights[index], heights[index + 1]];
  const allowed = Math.min(Math.max(change, min - upper), lower - min);
  const result = [...heights];
  if (lower - min < min - upper) return result; // both are too low already
  [result[index], result[index + 1]] = [upper + allowed, lower - allowed];
  return result;
}

export class TrackSizes {
  /** Heights in px when they were chosen, by charts. @type {Record<string, number[]>} */
  #chosen = {};
  #changed;

  /** @param {() => void} changed */
  constructor(changed) {
    this.#changed = changed;
    try {
      this.#chosen = JSON.parse(localStorage.getItem(STORAGE_KEY) ?? '{}');
    } catch {
      localStorage.removeItem(STORAGE_KEY);
    }
  }

  /**
   * Returns the chosen heights of charts, scaled to the height that they fill; else the given ones.
   * @param {readonly string[]} keys
   * @param {readonly number[]} heights px
   */
  apply(keys, heights) {
    const chosen = this.#chosen[keys.join()];
    if (!Array.isArray(chosen) || chosen.length !== heights.length) return [...heights];
    const [total, used] = [sum(heights), sum(chosen)];
    return used > 0 ? chosen.map((height) => Math.floor((height / used) * total)) : [...heights];
  }

  reset() {
    this.#chosen = {};
    this.#save();
  }

  /**
   * Creates the separator below a chart.
   * @param {readonly string[]} keys
   * @param {readonly number[]} heights px
   * @param {number} index of the chart
   */
  separator(keys, heights, index) {
    const bar = create('div', { className: 'track-splitter', role: 'separator', tabIndex: 0 });
    bar.ariaOrientation = 'horizontal';
    bar.ariaLabel = `Height of chart ${index + 1}`;
    bar.title = 'Drag or use the arrow keys';
    [bar.ariaValueMin, bar.ariaValueNow] = [String(MIN_HEIGHT), String(heights[index])];
    bar.ariaValueMax = String(heights[index] + heights[index + 1] - MIN_HEIGHT);
    /** @param {number} change px */
    const move = (change) => {
      this.#chosen[keys.join()] = withMovedBorder(heights, index, change);
      this.#save();
    };
    bar.addEventListener('pointerdown', (event) => {
      event.stopPropagation(); // no scrubbing
      const start = event.clientY;
      // The separator is replaced with each new height: the window follows the pointer.
      const follow = (/** @type {PointerEvent} */ { clientY }) => move(clientY - start);
      window.addEventListener('pointermove', follow);
      const stop = () => window.removeEventListener('pointermove', follow);
      window.addEventListener('pointerup', stop, { once: true });
      window.addEventListener('pointercancel', stop, { once: true });
    });
    bar.addEventListener('dblclick', (event) => {
      event.stopPropagation();
      this.reset();
    });
    bar.addEventListener('keydown', (event) => {
      const direction = { ArrowUp: -1, ArrowDown: 1 }[event.key];
      if (!direction) return;
      event.preventDefault();
      event.stopPropagation();
      const host = bar.closest('#tracks');
      move(KEY_STEP * direction);
      const next = host?.querySelectorAll('.track-splitter')[index];
      if (next instanceof HTMLElement) next.focus();
    });
    return bar;
  }

  #save() {
    localStorage.setItem(STORAGE_KEY, JSON.stringify(this.#chosen));
    this.#changed();
  }
}
