/** List of the weaknesses of a filter; a fine-tuning run addresses the selected one. */

/** @import { Store } from '../core/state.js' */
/** @import { Weakness } from '../types/server.js' */

import { create, createButton, html } from '../core/dom.js';
import { typeset } from '../core/units.js';

/**
 * Shows the weaknesses.
 * @param {HTMLElement} host
 * @param {Store} store
 * @param {Weakness[]} weaknesses the first is selected
 * @param {(settings: Weakness['settings']) => void} choose called with the settings of the selected weakness
 */
export function showWeaknesses(host, store, weaknesses, choose) {
  const items = weaknesses.map(({ title, evidence, episode, step, settings }, i) => {
    const input = create('input', { type: 'radio', name: 'weakness', checked: !i });
    input.addEventListener('change', () => choose(settings));
    const item = create(
      'div',
      { className: 'item' },
      create('label', {}, input, create('strong', { textContent: title })),
      create('p', { textContent: typeset(evidence) }),
    );
    if (episode !== null) {
      const text = step === null ? `episode ${episode}` : `episode ${episode}, step ${step}`;
      const open = () => store.set({ episode, step: step ?? 0, tab: 'diagnosis', playing: false });
      item.append(createButton('text quiet', text, open, { title: 'Show this step' }));
    }
    return item;
  });
  html('.list', host).replaceChildren(...items);
  html('.none', host).hidden = weaknesses.length > 0;
}
