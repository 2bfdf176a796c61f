/** Minimal replacements for the browser interfaces that the state uses. */

/** @type {Map<number, (now: number) => void>} */
const frames = new Map();
let handle = 0;

/** Entries of the history, the current one last. @type {string[]} */
export const history = [''];

Object.assign(globalThis, {
  /** @param {(now: number) => void} callback */
  requestAnimationFrame(callback) {
    frames.set(++handle, callback);
    return handle;
  },
  /** @param {number} key */
  cancelAnimationFrame: (key) => frames.delete(key),
  history: {
    /** @param {unknown} _ @param {string} __ @param {string} url */
    pushState: (_, __, url) => history.push(url),
    /** @param {unknown} _ @param {string} __ @param {string} url */
    replaceState: (_, __, url) => (history[history.length - 1] = url),
  },
});

/**
 * Runs the requested animation frames.
 * @param {number} [now] ms
 */
export function runFrames(now = 0) {
  const callbacks = [...frames.values()];
  frames.clear();
  for (const callback of callbacks) callback(now);
}
