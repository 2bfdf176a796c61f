/** The frame of the 3D scene. */

import { html } from '../core/dom.js';
import { setPanelState } from '../widgets/panel_state.js';

const NO_SCENE =
  'No 3D scene: this task has no replay, no outline, and no map over a position in m';

/**
 * Interface of viser_frame_throttle.js, in the frame.
 * @typedef {object} FrameThrottle
 * @property {(factor: number) => boolean} pause sets the pause after each slow rendering as a multiple of its duration, and returns whether the next may start now
 * @property {() => boolean} slow whether rendering is slow
 * @property {((slow: boolean) => void) | null} changed called after each rendering
 */

const STARTING = 'Starting the 3D scene …';

export class SceneFrame {
  #host;
  #failure = '';
  #frame = document.createElement('iframe');

  /** @param {HTMLElement} host */
  constructor(host) {
    this.#host = host;
    this.#frame.addEventListener('load', () => {
      const throttle = this.#throttle;
      if (throttle)
        throttle.changed = (slow) => {
          html('#software-rendering').hidden = !slow;
        };
    });
    this.#frame.title = '3D scene: robot, true state and estimates';
    setPanelState(host, 'loading', STARTING);
  }

  /** Why the selected run cannot be displayed; empty if it can. */
  set failure(/** @type {string} */ text) {
    if (text) setPanelState(this.#host, 'error', text);
    else if (this.#failure) setPanelState(this.#host, 'loading', STARTING);
    this.#failure = text;
  }

  /**
   * Loads the scene of a view.
   * @param {string} url
   * @param {Promise<unknown>} ready when loading may start: it delays other parts of the page
   */
  async open(url, ready) {
    if (!this.#failure) setPanelState(this.#host, 'loading', STARTING);
    await ready;
    if (this.#frame.isConnected) {
      this.#frame.contentWindow?.location.replace(url); // without a history entry
      return;
    }
    this.#frame.src = url;
    this.#host.append(this.#frame);
  }

  /**
   * Sets the pause between slow renderings. Returns whether the scene may render now.
   * @param {number} factor
   */
  pace(factor) {
    return this.#throttle?.pause(factor) ?? true;
  }

  /**
   * Called when the scene shows the cursor.
   * @param {string[]} layers of the scene
   */
  drawn(layers) {
    const state = layers.length ? 'ready' : 'empty';
    if (this.#host.dataset.state === state) return;
    setPanelState(this.#host, state, layers.length ? '' : NO_SCENE);
    this.#frame.hidden = !layers.length;
  }

  get #throttle() {
    return this.#frame.contentWindow?.frameThrottle;
  }
}
