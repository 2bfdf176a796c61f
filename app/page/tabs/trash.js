/** The deleted recordings and reports. */

/** @import { DeletedFile } from '../types/server.js' */

import { create, createButton, element, html } from '../core/dom.js';
import { formatBytes, plural } from '../core/units.js';
import { formatDate, smallNote } from './recording_columns.js';

/** @typedef {{id: string, name: string, kind: 'recordings' | 'reports'}} TrashedFile */

const BODY = `
  <summary>Trash</summary>
  <ul></ul>
  <p>
    <button type="button" class="text empty">Empty trash</button>
    <span class="confirmation" hidden>Delete permanently?
      <button type="button" class="text yes">Delete permanently</button>
      <button type="button" class="text no">Cancel</button>
    </span>
  </p>`;

export class Trash {
  #host;
  #emptyButton;
  #confirmation;
  #disabledReason;
  #restore;

  /**
   * @param {HTMLElement} host
   * @param {string | undefined} disabledReason set if files cannot be restored or deleted
   * @param {(file: TrashedFile) => void} restore
   * @param {() => void} empty
   */
  constructor(host, disabledReason, restore, empty) {
    this.#host = host;
    this.#disabledReason = disabledReason;
    this.#restore = restore;
    host.innerHTML = BODY;
    this.#emptyButton = element('.empty', HTMLButtonElement, host);
    this.#confirmation = html('.confirmation', host);
    this.#emptyButton.disabled = Boolean(disabledReason);
    this.#emptyButton.title = disabledReason ?? '';
    this.#emptyButton.addEventListener('click', () => {
      this.#confirmation.hidden = false;
      html('.no', host).focus();
    });
    html('.yes', host).addEventListener('click', () => {
      this.#confirmation.hidden = true;
      empty();
    });
    html('.no', host).addEventListener('click', () => {
      this.#confirmation.hidden = true;
      this.#emptyButton.focus();
    });
  }

  /** @param {(DeletedFile & TrashedFile)[]} files */
  show(files) {
    this.#host.hidden = !files.length;
    const size = formatBytes(files.reduce((sum, { bytes }) => sum + bytes, 0));
    html('summary', this.#host).textContent = `Trash: ${plural(files.length, 'file')}, ${size}`;
    this.#emptyButton.textContent = `Empty the trash (${size})`;
    html('ul', this.#host).replaceChildren(...files.map((file) => this.#item(file)));
  }

  /** @param {DeletedFile & TrashedFile} file */
  #item(file) {
    const button = createButton('text quiet', 'Restore', () => this.#restore(file), {
      ariaLabel: `Restore ${file.name}`,
      disabled: Boolean(this.#disabledReason),
    });
    const date = formatDate(new Date(1000 * file.deleted));
    const note = smallNote(`${formatBytes(file.bytes)}, deleted ${date}`);
    return create('li', {}, button, file.name, note);
  }
}
