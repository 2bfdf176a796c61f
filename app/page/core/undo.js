/** Undo and redo of what is looked at: an edit that was tried is taken back, with the moment that was shown. */

const UNDONE = ['task', 'filter', 'data', 'episode', 'faults', 'against'];
const ALONG = ['step', 'angle', 'component']; // come back with them
const KEPT = 100;

export class Undo {
  #store;
  #now;
  #past = [];
  #future = [];
  #going = false;

  /** @param {import('./state.js').Store} store */
  constructor(store) {
    this.#store = store;
    this.#now = this.#moment;
    store.listen((_, changed) => {
      if (!this.#going && UNDONE.some((key) => changed.has(key))) {
        this.#past = [...this.#past, this.#now].slice(-KEPT);
        this.#future = [];
      }
      this.#now = this.#moment;
    });
  }

  undo() {
    this.#go(this.#past, this.#future);
  }

  redo() {
    this.#go(this.#future, this.#past);
  }

  get #moment() {
    return Object.fromEntries([...UNDONE, ...ALONG].map((key) => [key, this.#store.state[key]]));
  }

  #go(from, to) {
    this.#store.flush(); // what has just been changed is to be undone, too
    const moment = from.pop();
    if (!moment) return;
    to.push(this.#now);
    this.#going = true;
    this.#store.set({ ...moment, playing: false });
    this.#store.flush();
    this.#going = false;
  }
}
