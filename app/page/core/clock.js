/** The page owns the time: it plays by moving the step as the episode's own clock would. */

import { SPEEDS } from './state.js';

export class Clock {
  #store;
  #steps = 0;
  #dt = 1;
  #before = 0;
  #due = 0; // steps, a fraction

  /** @param {import('./state.js').Store} store */
  constructor(store) {
    this.#store = store;
    store.listen((state, changed) => {
      if (changed.has('playing') && state.playing) this.#start();
      // Somebody who takes hold of the cursor does not want it pulled away.
      if (changed.has('step') && store.origin !== 'clock' && state.playing) store.set({ playing: false });
    });
  }

  /** @param {import('../data/trace.js').Trace | null} trace */
  show(trace) {
    this.#steps = trace?.steps ?? 0;
    this.#dt = trace?.dt ?? 1;
  }

  toggle() {
    this.#store.set({ playing: !this.#store.state.playing && this.#steps > 1 });
  }

  /** @param {number} direction -1 slower, 1 faster. */
  changeSpeed(direction) {
    const place = SPEEDS.indexOf(this.#store.state.speed) + direction;
    if (SPEEDS[place]) this.#store.set({ speed: SPEEDS[place] });
  }

  #start() {
    if (this.#store.state.step >= this.#steps - 1) this.#store.set({ step: 0 }, { origin: 'clock' });
    this.#before = performance.now();
    this.#due = 0;
    requestAnimationFrame((now) => this.#tick(now));
  }

  #tick(now) {
    const { playing, step, speed } = this.#store.state;
    if (!playing) return;
    this.#due += ((now - this.#before) / 1000) * (speed / this.#dt);
    this.#before = now;
    const whole = Math.max(0, Math.floor(this.#due));
    this.#due -= whole;
    const next = Math.min(step + whole, this.#steps - 1);
    this.#store.set({ step: next, playing: next < this.#steps - 1 }, { origin: 'clock', inputTime: null });
    this.#store.flush();
    requestAnimationFrame((later) => this.#tick(later));
  }
}
