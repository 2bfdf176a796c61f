/** Buttons that copy a text. */

import { copyText } from '../core/clipboard.js';
import { createButton } from '../core/dom.js';

const MESSAGE_TIME = 1500; // ms

/**
 * @param {string} text of the button
 * @param {string} label accessible name
 * @param {() => string} content what it copies
 */
export function copyButton(text, label, content) {
  const copy = async () => {
    button.textContent = (await copyText(content())) ? 'Copied' : 'Not permitted';
    setTimeout(() => (button.textContent = text), MESSAGE_TIME);
  };
  const button = createButton('text quiet', text, copy, { ariaLabel: label });
  return button;
}
