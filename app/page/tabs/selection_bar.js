/** The selected recordings, which can be opened in Rerun or compared in pairs. */

/** @import { RecordingEntry } from '../types/server.js' */

import { element, html } from '../core/dom.js';
import { comparisonProblem } from './recorded_run.js';

const BODY = `
  <span class="count"></span>
  <button type="button" class="text both">Open both in Rerun</button>
  <button type="button" class="text compare">Compare runs</button>
  <span class="problem"></span>
  <span class="spacer"></span>
  <button type="button" class="text quiet none">Clear selection</button>`;

export class SelectionBar {
  #host;
  /** @type {RecordingEntry[]} */
  #files = [];
  /** Names of the selected files. @type {Set<string>} */
  #names = new Set();

  /**
   * @param {HTMLElement} host
   * @param {{open: (files: RecordingEntry[]) => void, compare: (files: RecordingEntry[]) => void, clear: () => void}} handlers
   *   clear: called when the selection was cleared
   */
  constructor(host, { open, compare, clear }) {
    this.#host = host;
    host.innerHTML = BODY;
    html('.both', host).addEventListener('click', () => open(this.#selected));
    html('.compare', host).addEventListener('click', () => compare(this.#selected));
    html('.none', host).addEventListener('click', () => {
      this.#names.clear();
      clear();
    });
  }

  /** @param {string} name */
  has(name) {
    return this.#names.has(name);
  }

  /** @param {string} name */
  toggle(name) {
    if (!this.#names.delete(name)) this.#names.add(name);
    this.#draw();
  }

  /**
   * @param {string} name
   * @param {string} newName
   */
  rename(name, newName) {
    if (this.#names.delete(name)) this.#names.add(newName);
  }

  /**
   * Shows which of the files are selected. The selection loses files that no longer exist.
   * @param {RecordingEntry[]} files
   */
  show(files) {
    this.#files = files;
    const names = new Set(files.map(({ name }) => name));
    for (const name of this.#names) if (!names.has(name)) this.#names.delete(name);
    this.#draw();
  }

  /** Selected files, in the order of selection. */
  get #selected() {
    return [...this.#names].flatMap((name) => this.#files.filter((file) => file.name === name));
  }

  #draw() {
    const files = this.#selected;
    this.#host.hidden = !files.length;
    const isPair = files.length === 2;
    const isReadable = files.every(({ application }) => application);
    const problem = !isPair
      ? ''
      : isReadable
        ? comparisonProblem(files[0], files[1])
        : 'A selected file is unreadable.';
    html('.count', this.#host).textContent =
      files.length === 1
        ? '1 selected. Select another one to compare.'
        : `${files.length} selected`;
    element('.both', HTMLButtonElement, this.#host).disabled = !isPair || !isReadable;
    element('.compare', HTMLButtonElement, this.#host).disabled = !isPair || Boolean(problem);
    html('.problem', this.#host).textContent = problem;
  }
}
