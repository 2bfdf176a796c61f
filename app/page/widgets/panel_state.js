/** States of a panel without content, and the messages at the top of the page. */

import { create, createButton, html } from '../core/dom.js';
import { sentence } from '../core/units.js';

/**
 * Shows whether a panel is loading, empty, failed or ready. Its size stays the same.
 * @param {HTMLElement} body contains a `.note`
 * @param {'ready' | 'loading' | 'empty' | 'error'} state
 * @param {string} [text]
 * @param {number | null} [share] progress from 0 to 1
 */
export function setPanelState(body, state, text = '', share = null) {
  body.dataset.state = state;
  body.setAttribute('aria-busy', String(state === 'loading'));
  const note = html('.note', body);
  note.textContent = state === 'ready' ? '' : sentence(text);
  note.style.setProperty('--done', share === null ? '' : String(share));
  note.classList.toggle('measured', state === 'loading' && share !== null);
}

/**
 * Shows why a panel could not be loaded, and a button that loads it again.
 * @param {HTMLElement} body contains a `.note`
 * @param {string} text
 * @param {() => void} retry
 */
export function setPanelError(body, text, retry) {
  setPanelState(body, 'error', text);
  html('.note', body).append(createButton('text', 'Try again', retry));
}

/** Keys of messages that are no errors. */
const NOTICES = new Set(['deleted', 'failure', 'link']);

/** Messages at the top of the page, one per key; each stays until it is replaced, cleared or dismissed. */
export class Messages {
  #host;

  /** @param {HTMLElement} host */
  constructor(host) {
    this.#host = host;
  }

  /**
   * Shows a message in place of the one with the same key; an empty text removes that one.
   * @param {string} key
   * @param {string} [text]
   */
  show(key, text = '') {
    /** @type {HTMLElement | null} */
    const line = this.#host.querySelector(`[data-key="${key}"]`);
    const message = sentence(text);
    if (!message) line?.remove();
    else if (!line) this.#append(key, message);
    else if (html('span', line).textContent !== message) html('span', line).textContent = message;
  }

  /**
   * @param {string} key
   * @param {string} text
   */
  #append(key, text) {
    const close = createButton('', '×', () => line.remove(), { ariaLabel: 'Dismiss' });
    const line = create('p', {}, create('span', { textContent: text }), close);
    if (NOTICES.has(key)) line.className = 'notice';
    line.dataset.key = key;
    this.#host.append(line);
  }
}
