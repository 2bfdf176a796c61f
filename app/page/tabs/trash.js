/** The deleted recordings and reports. */

/** @import { DeletedFile } from '../types/server.js' */

import { create, createButton, element, html } from '../core/dom.js';
import { formatBytes, plural } from '../core/units.js';
import { sum } from '../data/arrays.js';
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

/**
 * Builds the trash.
 * @param {HTMLElement} host
 * @param {string | undefined} disabledReason set if files cannot be restored or deleted
 * @param {(file: TrashedFile) => void} restore
 * @param {() => void} empty
 * @returns {(files: (DeletedFile & TrashedFile)[]) => void} shows files
 */
export function trash(host, disabledReason, restore, empty) {
  host.innerHTML = BODY;
  const emptyButton = element('.empty', HTMLButtonElement, host);
  const confirmation = html('.confirmation', host);
  [emptyButton.disabled, emptyButton.title] = [Boolean(disabledReason), disabledReason ?? ''];
  emptyButton.addEventListener('click', () => {
    confirmation.hidden = false;
    html('.no', host).focus();
  });
  html('.yes', host).addEventListener('click', () => {
    confirmation.hidden = true;
    empty();
  });
  html('.no', host).addEventListener('click', () => {
    confirmation.hidden = true;
    emptyButton.focus();
  });
  /** @param {DeletedFile & TrashedFile} file */
  const item = (file) => {
    const button = createButton('text quiet', 'Restore', () => restore(file), {
      ariaLabel: `Restore ${file.name}`,
      disabled: Boolean(disabledReason),
    });
    const date = formatDate(new Date(1000 * file.deleted));
    const note = smallNote(`${formatBytes(file.bytes)}, deleted ${date}`);
    return create('li', {}, button, file.name, note);
  };
  return (files) => {
    host.hidden = !files.length;
    const size = formatBytes(sum(files.map(({ bytes }) => bytes)));
    html('summary', host).textContent = `Trash: ${plural(files.length, 'file')}, ${size}`;
    emptyButton.textContent = `Empty the trash (${size})`;
    html('ul', host).replaceChildren(...files.map(item));
  };
}
