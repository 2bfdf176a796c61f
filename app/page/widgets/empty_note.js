/** Contents of a panel that has nothing to show yet: what belongs there, and the commands that make it. */

import { create } from '../core/dom.js';
import { copyButton } from './copy_button.js';

/**
 * Returns the elements of the note.
 * @param {object} note
 * @param {string} note.title
 * @param {(string | Node)[][]} note.paragraphs
 * @param {string} note.purpose of the commands
 * @param {string[]} note.commands
 */
export function emptyNote({ title, paragraphs, purpose, commands }) {
  const text = commands.join('\n');
  return [
    create('h4', { textContent: title }),
    ...paragraphs.map((content) => create('p', {}, ...content)),
    create(
      'p',
      {},
      `${purpose} `,
      copyButton('Copy', 'Copy the commands', () => text),
    ),
    create('pre', { textContent: text }),
  ];
}
