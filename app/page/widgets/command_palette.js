/** The command palette: a search field over all commands, with a list that the arrow keys move through. */

/** @import { Command } from '../core/commands.js' */

import { create, element, html } from '../core/dom.js';
import { search } from '../core/search.js';

const MAX_OPTIONS = 60;
const PAUSE = 120; // ms without input before the server is asked

export class CommandPalette {
  #dialog;
  #input;
  #list;
  #none;
  #source;
  #byQuery;
  #remote;
  /** @type {number | undefined} */
  #timer;
  /** @type {Command[]} */
  #all = [];
  /** @type {Command[]} */
  #displayed = [];
  #active = 0;

  /**
   * @param {HTMLDialogElement} dialog
   * @param {() => Command[]} source commands that are available when it opens
   * @param {(query: string) => Command[]} byQuery commands that the query itself stands for
   * @param {(query: string) => Promise<Command[]>} remote commands that the server finds
   */
  constructor(dialog, source, byQuery, remote) {
    this.#dialog = dialog;
    this.#source = source;
    this.#byQuery = byQuery;
    this.#remote = remote;
    this.#input = element('input', HTMLInputElement, dialog);
    this.#list = html('[role=listbox]', dialog);
    this.#none = html('.none', dialog);
    this.#input.addEventListener('input', () => this.#draw());
    this.#input.addEventListener('keydown', (event) => this.#press(event));
    this.#list.addEventListener('pointerdown', (event) => event.preventDefault()); // keeps the focus
    this.#list.addEventListener('click', ({ target }) => {
      const option = target instanceof Element ? target.closest('[role=option]') : null;
      if (option) this.#run([...this.#list.children].indexOf(option));
    });
    dialog.addEventListener('click', ({ target }) => {
      if (target === dialog) dialog.close(); // the backdrop
    });
  }

  /** @param {string} [query] */
  toggle(query = '') {
    if (this.#dialog.open) return this.#close();
    this.#all = this.#source();
    this.#input.value = query;
    this.#draw();
    this.#dialog.showModal();
  }

  #draw() {
    const query = this.#input.value;
    const matches = search(
      query,
      this.#all,
      ({ group, title, words = '' }) => `${title} ${group} ${words}`,
    );
    this.#show([...this.#byQuery(query), ...matches]);
    this.#activate(0);
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#request(query), PAUSE);
  }

  /**
   * Adds the commands that the server finds, unless the query has changed.
   * @param {string} query
   */
  async #request(query) {
    const matches = await this.#remote(query).catch(() => []);
    if (!matches.length || query !== this.#input.value || !this.#dialog.open) return;
    this.#show([...this.#displayed, ...matches]);
    this.#activate(this.#active);
  }

  /** @param {Command[]} commands */
  #show(commands) {
    this.#displayed = commands.slice(0, MAX_OPTIONS);
    this.#list.replaceChildren(...this.#displayed.map(option));
    this.#list.hidden = !this.#displayed.length;
    this.#none.textContent = this.#displayed.length ? '' : 'No matching command.';
    this.#input.ariaExpanded = String(this.#displayed.length > 0);
  }

  /** @param {KeyboardEvent} event */
  #press(event) {
    const last = this.#displayed.length - 1;
    /** @type {Record<string, number>} */
    const targets = {
      ArrowDown: this.#active === last ? 0 : this.#active + 1,
      ArrowUp: this.#active === 0 ? last : this.#active - 1,
      PageDown: Math.min(this.#active + 10, last),
      PageUp: Math.max(this.#active - 10, 0),
    };
    const isToggle = (event.ctrlKey || event.metaKey) && event.key.toLowerCase() === 'k';
    if (isToggle) this.toggle();
    else if (event.key === 'Enter') this.#run(this.#active);
    else if (event.key in targets) this.#activate(targets[event.key]);
    else return;
    event.preventDefault();
    event.stopPropagation();
  }

  /** @param {number} index */
  #activate(index) {
    this.#active = index;
    [...this.#list.children].forEach((row, i) => (row.ariaSelected = String(i === index)));
    const row = this.#list.children[index];
    this.#input.setAttribute('aria-activedescendant', row?.id ?? '');
    row?.scrollIntoView({ block: 'nearest' });
  }

  /** @param {number} index */
  #run(index) {
    const command = this.#displayed[index];
    if (!command) return;
    this.#close();
    command.run();
  }

  #close() {
    this.#input.blur(); // otherwise it keeps the focus, and the keys, until the next frame
    this.#dialog.close();
  }
}

/**
 * @param {Command} command
 * @param {number} index
 */
function option({ group, title, keys }, index) {
  const row = create('div', { id: `command-${index}`, role: 'option' });
  row.append(create('small', { textContent: group }), create('span', { textContent: title }));
  if (keys) row.append(create('kbd', { textContent: keys }));
  return row;
}
