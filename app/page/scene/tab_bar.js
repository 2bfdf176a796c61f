/** The left of the page: tabs for the 3D scene, for Rerun's viewer, for the diagnostics, for failures, for comparisons, for fine-tuning and for studies. */

import { say } from '../widgets/panel_state.js';

const TABS = ['scene', 'rerun', 'diagnostics', 'failures', 'compare', 'finetune', 'study', 'recordings'];

/** The scene's frame: another page of the server's, which follows the cursor by itself. */
export class Scene {
  #host;
  #frame = document.createElement('iframe');

  /** @param {HTMLElement} host */
  constructor(host) {
    this.#host = host;
    this.#frame.addEventListener('load', () => {
      const { drawing } = this.#frame.contentWindow;
      if (drawing) drawing.told = (slow) => (document.querySelector('#slow').hidden = !slow);
    });
    this.#frame.title = '3D scene: the robot, the truth and the estimates';
    say(host, 'loading', 'Starting the 3D scene …');
  }

  /** @param {string} url of a new view's scene @param {Promise<unknown>} when it may start: it is a whole page */
  async open(url, when) {
    say(this.#host, 'loading', 'Starting the 3D scene …');
    await when;
    if (this.#frame.isConnected) return this.#frame.contentWindow.location.replace(url); // no place in the history
    this.#frame.src = url;
    this.#host.append(this.#frame);
  }

  /** Whether a drawing may be now, and the pause after each where drawing is slow (frame.js). @param {number} times of its cost */
  pace(times) {
    return this.#frame.contentWindow?.drawing?.pause(times) ?? true;
  }

  /** The server has drawn a cursor. */
  drawn() {
    if (this.#host.dataset.state !== 'ready') say(this.#host, 'ready');
  }
}

/**
 * @param {import('../core/state.js').Store} store
 * @returns {(tab: string) => void} shows a tab
 */
export function tabs(store) {
  const buttons = TABS.map((name) => document.querySelector(`#tab-${name}`));
  buttons.forEach((button, i) => {
    button.addEventListener('click', () => store.set({ tab: TABS[i] }));
    button.addEventListener('keydown', (event) => {
      if (event.key !== 'ArrowLeft' && event.key !== 'ArrowRight') return;
      event.stopPropagation();
      const other = (i + (event.key === 'ArrowRight' ? 1 : TABS.length - 1)) % TABS.length;
      store.set({ tab: TABS[other] });
      buttons[other].focus();
    });
  });
  return (shown) => {
    TABS.forEach((name, i) => {
      buttons[i].setAttribute('aria-selected', String(name === shown));
      buttons[i].tabIndex = name === shown ? 0 : -1;
      document.querySelector(`#${name}`).hidden = name !== shown;
    });
    // Where the tabs do not all fit, the chosen one is in sight.
    buttons[TABS.indexOf(shown)].scrollIntoView({ block: 'nearest', inline: 'nearest' });
  };
}
