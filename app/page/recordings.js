/** "Save .rrd": writes a recording and says where it is. */

import { bytes, fixed } from './units.js';

/**
 * @param {HTMLButtonElement} button @param {HTMLElement} host where the result is told
 * @param {() => Promise<import('./api.js').Recording>} write @param {() => void} open shows it in the Rerun tab.
 * @param {(name: string) => void} keep shows where it is among the others
 * @returns {() => Promise<void>} what the button does
 */
export function saving(button, host, write, open, keep) {
  const tell = (...children) => {
    const close = document.createElement('button');
    [close.type, close.textContent] = ['button', '×'];
    close.setAttribute('aria-label', 'Dismiss');
    close.addEventListener('click', () => host.replaceChildren());
    const line = document.createElement('p');
    line.append(...children, close);
    host.replaceChildren(line);
  };
  const save = async () => {
    if (button.disabled) return;
    [button.disabled, button.textContent] = [true, 'Writing …'];
    tell('Writing the recording: numbers of every step, likelihood maps at even steps …');
    try {
      const recording = await write();
      const link = document.createElement('a');
      [link.href, link.download, link.textContent] = [recording.url, recording.name, `Download ${recording.name}`];
      const [view, place] = [['Open in Rerun tab', open], ['Recordings', () => keep(recording.name)]].map(([textContent, act]) => {
        const made = Object.assign(document.createElement('button'), { type: 'button', className: 'text', textContent });
        made.addEventListener('click', () => (host.replaceChildren(), act()));
        return made;
      });
      const when = recording.seconds === null ? 'written before' : `written in ${fixed(recording.seconds)} s`;
      tell(link, ` ${bytes(recording.bytes)}, ${when} `, view, place);
    } catch (error) {
      tell(`The recording was not written: ${error.message}`);
    } finally {
      [button.disabled, button.textContent] = [false, 'Save .rrd'];
    }
  };
  button.addEventListener('click', save);
  return save;
}
