/** A line with the result of the last action, which can be undone or dismissed. */

import { html } from '../core/dom.js';

/** @typedef {{text: string, undo?: () => void, failed?: boolean}} Status */

const BODY = `
  <span></span>
  <button type="button" class="text">Undo</button>
  <button type="button" class="quiet" aria-label="Dismiss">×</button>`;

export class StatusLine {
  #host;
  /** @type {(() => void) | undefined} */
  #undo;

  /** @param {HTMLElement} host */
  constructor(host) {
    this.#host = host;
    host.innerHTML = BODY;
    host.hidden = true;
    html('.text', host).addEventListener('click', () => this.#undo?.());
    html('.quiet', host).addEventListener('click', () => (host.hidden = true));
  }

  /** @param {Status} status */
  show({ text, undo, failed = false }) {
    this.#undo = undo;
    this.#host.hidden = false;
    this.#host.dataset.state = failed ? 'error' : 'done';
    html('span', this.#host).textContent = text;
    html('.text', this.#host).hidden = !undo;
  }

  /** Moves the focus to the Undo button. */
  focus() {
    html('.text', this.#host).focus();
  }
}
