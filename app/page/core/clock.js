/** Playback: advances the step at the speed of the episode. */

/** @import { Trace } from '../data/trace.js' */
/** @import { Store } from './state.js' */

import { SPEEDS } from './state.js';

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

  /**
   * Returns the s from a step to the next one.
   * @param {number} step
   */
  #duration(step) {
    return this.#trace ? this.#trace.seconds(step + 1) - this.#trace.seconds(step) : 1;
  }

  #start() {
    if (this.#store.state.step >= this.#last) this.#store.set({ step: 0 }, { origin: 'clock' });
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
    let next = step;
    for (; next < this.#last; next += 1) {
      const duration = this.#duration(next);
      if (this.#pending < duration) break;
      this.#pending -= duration;
    }
    this.#store.set(
      { step: next, playing: next < this.#last },
      { origin: 'clock', inputTime: null },
    );
    this.#store.flush();
    requestAnimationFrame((later) => this.#tick(later));
  }
}
