/** The menu of the Experiments tab with the entries of the provenance that distinguish groups of checkpoints. */

/** @import { ExperimentRow } from '../types/server.js' */

import { create, html } from '../core/dom.js';
import { differingEntries, entryText, settingEntries } from './experiment_provenance.js';
import { valueOf } from './experiment_rows.js';

const NONE = ','; // in the permalink; an empty text is the default
const EXAMPLES = 3; // values of an entry in the menu

/**
 * Names of columns in a permalink, which may contain commas.
 * @param {string} text
 */
export const namesIn = (text) => text.split(',').filter(Boolean).map(decodeURIComponent);

/**
 * Entries that distinguish groups.
 * @param {ExperimentRow[]} rows
 * @param {string} chosen as in the permalink
 */
export function groupEntries(rows, chosen) {
  if (!chosen) return settingEntries(rows);
  const names = namesIn(chosen);
  return differingEntries(rows).filter((name) => names.includes(name));
}

/**
 * Names as in the permalink.
 * @param {string[]} names
 */
export const namesText = (names) => names.map(encodeURIComponent).join();

export class GroupMenu {
  #button;
  #menu;
  #choose;
  /** @type {ExperimentRow[]} */
  #rows = [];
  #chosen = '';

  /**
   * @param {HTMLElement} host of the button and the menu
   * @param {(chosen: string) => void} choose
   */
  constructor(host, choose) {
    this.#choose = choose;
    this.#button = html('.group-by', host);
    this.#menu = html('.group-menu', host);
    this.#menu.addEventListener('beforetoggle', () => {
      const { bottom, left } = this.#button.getBoundingClientRect();
      [this.#menu.style.top, this.#menu.style.left] = [`${bottom + 4}px`, `${left}px`];
      this.#menu.style.maxHeight = `${window.innerHeight - bottom - 16}px`;
      this.#draw();
    });
    html('.reset', this.#menu).addEventListener('click', () => this.#set(''));
  }

  /**
   * @param {ExperimentRow[]} rows
   * @param {string} chosen as in the permalink
   * @param {boolean} areGroups whether the rows are joined
   */
  show(rows, chosen, areGroups) {
    [this.#rows, this.#chosen] = [rows, chosen];
    this.#button.hidden = !areGroups;
    const count = groupEntries(rows, chosen).length;
    this.#button.textContent = `Group by ${count} of ${differingEntries(rows).length} entries…`;
  }

  /** @param {string} chosen */
  #set(chosen) {
    this.#chosen = chosen;
    this.#draw();
    this.#choose(chosen);
  }

  #draw() {
    const names = groupEntries(this.#rows, this.#chosen);
    const items = differingEntries(this.#rows).map((name) => {
      const box = create('input', { type: 'checkbox', checked: names.includes(name) });
      box.addEventListener('change', () => {
        const others = names.filter((other) => other !== name);
        this.#set(namesText(box.checked ? [...others, name] : others) || NONE);
        this.#focus(name);
      });
      const values = new Set(this.#rows.map((row) => valueOf(row, name)));
      values.delete(null);
      const examples = [...values].slice(0, EXAMPLES).map(entryText).join(', ');
      const more = values.size > EXAMPLES ? `, … (${values.size})` : '';
      const example = create('span', { textContent: `${examples}${more}` });
      const item = create('li', {}, create('label', {}, box, name, example));
      item.dataset.name = name;
      return item;
    });
    html('ul', this.#menu).replaceChildren(...items);
    html('.none', this.#menu).hidden = items.length > 0;
  }

  /** @param {string} name */
  #focus(name) {
    const items = [...html('ul', this.#menu).children];
    const item = items.find((li) => li instanceof HTMLElement && li.dataset.name === name);
    item?.querySelector('input')?.focus();
  }
}
