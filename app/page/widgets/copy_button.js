/** Buttons that copy a text. */

import { copyText } from '../core/clipboard.js';
import { create } from '../core/dom.js';

const MESSAGE_TIME = 1500; // ms

/**
 * @param {string} text of the button
 * @param {string} label accessible name
 * @param {() => string} content what it copies
 */
export function copyButton(text, label, content) {
  const button = create('button', { type: 'button', className: 'text quiet', textContent: text });
  button.ariaLabel = label;
  button.addEventListener('click', async () => {
    button.textContent = (await copyText(content())) ? 'Copied' : 'Not permitted';
    setTimeout(() => (button.textContent = text), MESSAGE_TIME);
  });
  return button;
}
