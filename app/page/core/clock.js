/** Playback: advances the step at the speed of the episode, and repeats the visible steps of a zoomed timeline. */

/** @import { Trace } from '../data/trace.js' */
/** @import { Store } from './state.js' */

import { parseWindow } from '../timeline/step_window.js';
import { SPEEDS } from './state.js';

const MIN_DURATION = 1e-3; // s of a step

export class Clock {
  /** @type {Store} */
  #store;
  /** @type {Trace | null} */
  #trace = null;
  #lastFrame = 0; // ms
  #pending = 0; // s of the episode

  /** @param {Store} store */
  constructor(store) {
    this.#store = store;
    store.listen((state, changed) => {
      if (changed.has('playing') && state.playing) this.#start();
      // Moving the cursor pauses the playback.
      if (changed.has('step') && store.origin !== 'clock' && state.playing)
        store.set({ playing: false });
    });
  }

  /** @param {Trace | null} trace */
  show(trace) {
    this.#trace = trace;
  }

  toggle() {
    this.#store.set({ playing: !this.#store.state.playing && this.#last > 0 });
  }

  /** @param {number} direction -1 slower, 1 faster */
  changeSpeed(direction) {
    const speed = SPEEDS[SPEEDS.indexOf(this.#store.state.speed) + direction];
    if (speed) this.#store.set({ speed });
  }

  /** The last step. */
  get #last() {
    return (this.#trace?.steps ?? 1) - 1;
  }

  /** The first and last visible step. */
  get #visible() {
    const [from, to] = parseWindow(this.#store.state.window, [0, this.#last]);
    return [Math.ceil(from), Math.min(Math.floor(to), this.#last)];
  }

  /**
   * Returns the s from a step to the next one.
   * @param {number} step
   */
  #duration(step) {
    return this.#trace ? this.#trace.seconds(step + 1) - this.#trace.seconds(step) : 1;
  }

  #start() {
    const [from, to] = this.#visible;
    const { step } = this.#store.state;
    if (step < from || step >= to) this.#store.set({ step: from }, { origin: 'clock' });
    this.#lastFrame = performance.now();
    this.#pending = 0;
    requestAnimationFrame((now) => this.#tick(now));
  }

  /** @param {number} now ms */
  #tick(now) {
    const { playing, step, speed } = this.#store.state;
    if (!playing) return;
    this.#pending += ((now - this.#lastFrame) / 1000) * speed;
    this.#lastFrame = now;
    const [from, to] = this.#visible;
    const repeats = Boolean(this.#store.state.window);
    let next = step;
    while (next < to || repeats) {
      // The bound keeps equal times from repeating without end.
      const duration = Math.max(this.#duration(Math.min(next, to - 1)), MIN_DURATION);
      if (!(this.#pending >= duration)) break;
      this.#pending -= duration;
      next = next < to ? next + 1 : from;
    }
    this.#store.set(
      { step: next, playing: repeats || next < to },
      { origin: 'clock', inputTime: null },
    );
    this.#store.flush();
    requestAnimationFrame((later) => this.#tick(later));
  }
}
