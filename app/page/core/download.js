/** Files that the page makes. */

import { create } from './dom.js';

/**
 * @param {Blob} blob
 * @param {string} name
 */
export function download(blob, name) {
  const link = create('a', { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

/** @param {unknown[][]} rows */
export const csv = (rows) => rows.map((row) => `${row.map(csvField).join(',')}\n`).join('');

/** @param {unknown} value */
function csvField(value) {
  const text = String(value ?? '');
  return /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
}
