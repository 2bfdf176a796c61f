/** Playback: advances the step at the speed of the episode. */

/** @import { Trace } from '../data/trace.js' */
/** @import { Store } from './state.js' */

import { SPEEDS } from './state.js';

export class Clock {
  /** @type {Store} */
  #store;
  #steps = 0;
  #dt = 1;
  #lastFrame = 0; // ms
  #pending = 0; // steps, with a fraction

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
    this.#steps = trace?.steps ?? 0;
    this.#dt = trace?.dt ?? 1;
  }

  toggle() {
    this.#store.set({ playing: !this.#store.state.playing && this.#steps > 1 });
  }

  /** @param {number} direction -1 slower, 1 faster */
  changeSpeed(direction) {
    const speed = SPEEDS[SPEEDS.indexOf(this.#store.state.speed) + direction];
    if (speed) this.#store.set({ speed });
  }

  #start() {
    if (this.#store.state.step >= this.#steps - 1)
      this.#store.set({ step: 0 }, { origin: 'clock' });
    this.#lastFrame = performance.now();
    this.#pending = 0;
    requestAnimationFrame((now) => this.#tick(now));
  }

  /** @param {number} now ms */
  #tick(now) {
    const { playing, step, speed } = this.#store.state;
    if (!playing) return;
    this.#pending += ((now - this.#lastFrame) / 1000) * (speed / this.#dt);
    this.#lastFrame = now;
    const advance = Math.max(0, Math.floor(this.#pending));
    this.#pending -= advance;
    const next = Math.min(step + advance, this.#steps - 1);
    this.#store.set(
      { step: next, playing: next < this.#steps - 1 },
      { origin: 'clock', inputTime: null },
    );
    this.#store.flush();
    requestAnimationFrame((later) => this.#tick(later));
  }
}
