/** Sortable table of files: each name opens its file or becomes a text field, and each row has a menu of actions. */

/** @import { Sort } from './sorting.js' */

import { create, createButton, element, focusedIn, messageOf } from '../core/dom.js';
import { navigateRows, setTabStop } from './row_navigation.js';
import { sortHeading, sortRows } from './sorting.js';

/**
 * Action on a file.
 * @typedef {object} Action
 * @property {string} name
 * @property {string} [key] keyboard shortcut in the row
 * @property {() => void} [run]
 * @property {string} [href] a link in place of `run`
 * @property {string} [download] name of the file that the link saves
 * @property {boolean} [newWindow] whether the link opens a new window
 * @property {string} [disabledReason] set if the action is not possible
 * @property {string} [hint]
 */

/**
 * @template {{name: string}} F
 * @typedef {object} Column
 * @property {string} name
 * @property {string} title
 * @property {string} help
 * @property {(file: F) => string | number | null} value sort key; null if there is none
 * @property {(file: F) => string | Node} content
 * @property {(file: F) => string} [hint]
 * @property {boolean} [number]
 */

/**
 * @template {{name: string}} F
 * @typedef {object} FileTableOptions
 * @property {(file: F) => Action[]} actions the first one is run by a click on the name
 * @property {Sort} sort
 * @property {{has: (name: string) => boolean, toggle: (name: string) => void}} [selection] gives each row a checkbox
 */

/** @template {{name: string}} F */
export class FileTable {
  #table;
  #head;
  #body;
  #menu = create('div', { popover: 'auto', className: 'menu', role: 'menu' });
  #columns;
  #actions;
  #selection;
  #sort;
  /** @type {F[]} */
  #files = [];
  /** Rows by file name. @type {Map<string, HTMLTableRowElement>} */
  #rows = new Map();
  #editing = false;
  #highlighted = '';

  /**
   * @param {HTMLTableElement} table
   * @param {Column<F>[]} columns the first one has the name
   * @param {FileTableOptions<F>} options
   */
  constructor(table, columns, { actions, sort, selection }) {
    this.#table = table;
    this.#columns = columns;
    this.#actions = actions;
    this.#sort = sort;
    this.#selection = selection;
    this.#head = element('thead', HTMLTableSectionElement, table);
    this.#body = element('tbody', HTMLTableSectionElement, table);
    table.after(this.#menu);
    this.#menu.addEventListener('keydown', (event) => this.#navigateMenu(event));
    navigateRows(this.#body);
    this.#body.addEventListener('keydown', (event) => this.#runShortcut(event));
  }

  /**
   * Shows files. While a name is edited, the table is updated when editing ends.
   * @param {F[]} files
   */
  show(files) {
    this.#files = files;
    if (!this.#editing) this.#draw();
  }

  /**
   * Highlights the row of a file and scrolls it into view.
   * @param {string} name
   */
  point(name) {
    this.#highlighted = name;
    for (const [other, row] of this.#rows) row.classList.toggle('here', other === name);
    const row = this.#rows.get(name);
    if (row) setTabStop(row, true);
  }

  /**
   * Replaces the name of a file by a text field.
   * @param {F} file
   * @param {string} label
   * @param {string} text
   * @param {(text: string) => Promise<void>} save throws the reason if the text is invalid
   */
  edit(file, label, text, save) {
    const cell = this.#rows.get(file.name)?.querySelector('.name');
    if (!cell) return;
    const input = create('input', { type: 'text', autocomplete: 'off', spellcheck: false });
    const error = create('p', { className: 'error', role: 'alert' });
    const form = create('form', {}, input, error);
    [input.value, input.ariaLabel] = [text, label];
    this.#editing = true;
    const end = () => {
      if (!this.#editing) return;
      this.#editing = false;
      this.#draw();
      const row = this.#rows.get(file.name) ?? this.#rows.get(this.#highlighted); // after a renaming
      if (row) setTabStop(row, true);
    };
    const submit = async () => {
      if (input.value === text) return end();
      input.disabled = true;
      try {
        await save(input.value);
        end();
      } catch (reason) {
        [input.disabled, error.textContent] = [false, messageOf(reason)];
        input.setAttribute('aria-invalid', 'true');
        input.focus();
      }
    };
    form.addEventListener('submit', (event) => (event.preventDefault(), submit()));
    form.addEventListener('keydown', (event) => {
      event.stopPropagation();
      if (event.key === 'Escape') end();
    });
    form.addEventListener('focusout', () => !input.disabled && !error.textContent && submit());
    cell.replaceChildren(form);
    input.focus();
    input.select();
  }

  get #sorted() {
    const column = this.#columns.find(({ name }) => name === this.#sort.name) ?? this.#columns[0];
    return sortRows(this.#files, column.value, this.#sort.down, true);
  }

  #draw() {
    const focused = focusedIn(this.#table);
    const [name, part] = [focused?.closest('tr')?.dataset.name, focused?.dataset.part];
    const head = document.createElement('tr');
    if (this.#selection) head.append(hiddenHeading('Selected', 'pick'));
    head.append(
      ...this.#columns.map((column) => this.#heading(column)),
      hiddenHeading('Menu', 'menus'),
    );
    this.#head.replaceChildren(head);
    const files = this.#sorted;
    this.#rows = new Map(files.map((file, i) => [file.name, this.#row(file, i)]));
    this.#body.replaceChildren(...this.#rows.values());
    this.#table.hidden = !files.length;
    const row = name === undefined ? undefined : this.#rows.get(name);
    if (row) setTabStop(row, false);
    const place = name === undefined ? this.#head : row;
    /** @type {HTMLElement | null | undefined} */
    const control = place?.querySelector(`[data-part="${part}"]`);
    control?.focus({ preventScroll: true });
  }

  /** @param {Column<F>} column */
  #heading(column) {
    const apply = (/** @type {Sort} */ sort) => {
      this.#sort = sort;
      this.#draw();
    };
    const cell = sortHeading(column, this.#sort, apply, Boolean(column.number));
    cell.classList.add(`of-${column.name}`);
    return cell;
  }

  /**
   * @param {F} file
   * @param {number} i place in the table
   */
  #row(file, i) {
    const row = document.createElement('tr');
    row.dataset.name = file.name;
    row.classList.toggle('here', file.name === this.#highlighted);
    const actions = this.#actions(file);
    if (this.#selection) this.#addCheckbox(row, file, this.#selection);
    for (const [c, { name, content, hint, number }] of this.#columns.entries()) {
      const cell = row.insertCell();
      cell.className = c ? `${number ? 'number ' : ''}of-${name}` : 'name';
      cell.title = hint?.(file) ?? '';
      if (c) cell.append(content(file));
      else cell.append(create('div', {}, this.#nameButton(file, actions[0]), content(file)));
    }
    const more = createButton('quiet more', '⋯', () => this.#openMenu(more, actions), {
      ariaHasPopup: 'menu',
      title: 'Actions',
      ariaLabel: `Menu of ${file.name}`,
    });
    more.dataset.part = 'more';
    row.insertCell().append(more);
    /** @type {NodeListOf<HTMLElement>} */
    const controls = row.querySelectorAll('button, input');
    for (const control of controls) control.tabIndex = i ? -1 : 0;
    return row;
  }

  /**
   * @param {HTMLTableRowElement} row
   * @param {F} file
   * @param {NonNullable<FileTableOptions<F>['selection']>} selection
   */
  #addCheckbox(row, { name }, selection) {
    const checkbox = create('input', {
      type: 'checkbox',
      checked: selection.has(name),
      ariaLabel: `Select ${name}`,
    });
    checkbox.dataset.part = 'pick';
    checkbox.addEventListener('change', () => selection.toggle(name));
    const cell = row.insertCell();
    cell.className = 'pick';
    cell.append(checkbox);
  }

  /**
   * @param {F} file
   * @param {Action} action
   */
  #nameButton(file, { name, disabledReason }) {
    const run = () => this.#run(file, (action) => action.name === name);
    const button = createButton('title', file.name, run, {
      title: disabledReason ?? `${name}: ${file.name}`,
      ariaDisabled: String(Boolean(disabledReason)),
    });
    button.dataset.part = 'open';
    return button;
  }

  /**
   * @param {F} file
   * @param {(action: Action) => boolean} matches
   */
  #run(file, matches) {
    const action = this.#actions(file).find(matches);
    if (!action || action.disabledReason) return;
    if (action.href) actionLink(action).click();
    else action.run?.();
  }

  /** @param {KeyboardEvent} event */
  #runShortcut(event) {
    if (!(event.target instanceof Element) || event.target.closest('form')) return;
    const row = event.target.closest('tr');
    const file = this.#files.find(({ name }) => name === row?.dataset.name);
    if (!file || event.key === 'Enter') return; // Enter clicks the button
    if (!this.#actions(file).some(({ key }) => key === event.key)) return;
    event.preventDefault();
    event.stopPropagation();
    this.#run(file, ({ key }) => key === event.key);
  }

  /**
   * @param {HTMLElement} button
   * @param {Action[]} actions
   */
  #openMenu(button, actions) {
    const items = actions.map((action) => this.#menuItem(action));
    this.#menu.replaceChildren(...items);
    this.#menu.showPopover();
    const [anchor, size] = [button.getBoundingClientRect(), this.#menu.getBoundingClientRect()];
    const left = Math.min(anchor.right - size.width, innerWidth - size.width - 4);
    const fitsBelow = anchor.bottom + size.height <= innerHeight - 4;
    this.#menu.style.left = `${Math.max(4, left)}px`;
    this.#menu.style.top = `${fitsBelow ? anchor.bottom : Math.max(4, anchor.top - size.height)}px`;
    items[0]?.focus();
  }

  /** @param {Action} action */
  #menuItem(action) {
    const { name, key, disabledReason, hint } = action;
    const item =
      action.href && !disabledReason ? actionLink(action) : create('button', { type: 'button' });
    item.setAttribute('role', 'menuitem');
    item.setAttribute('aria-disabled', String(Boolean(disabledReason)));
    item.tabIndex = -1;
    item.append(create('span', { textContent: name }));
    if (key) item.append(create('kbd', { textContent: key === 'Delete' ? 'del' : key }));
    const note = disabledReason ?? hint;
    if (note) item.append(create('small', { textContent: note }));
    item.addEventListener('click', () => {
      if (disabledReason) return;
      this.#menu.hidePopover();
      action.run?.();
    });
    return item;
  }

  /** @param {KeyboardEvent} event */
  #navigateMenu(event) {
    event.stopPropagation();
    const items = [...this.#menu.children];
    const place = items.findIndex((item) => item === document.activeElement);
    /** @type {Record<string, number>} */
    const targets = { ArrowDown: place + 1, ArrowUp: place - 1, Home: 0, End: -1 };
    if (event.key === 'Tab') this.#menu.hidePopover();
    if (!(event.key in targets)) return;
    event.preventDefault();
    const item = items.at(targets[event.key] % items.length);
    if (item instanceof HTMLElement) item.focus();
  }
}

/**
 * Creates a heading for screen readers only.
 * @param {string} text
 * @param {string} className
 */
function hiddenHeading(text, className) {
  const label = create('span', { className: 'visually-hidden', textContent: text });
  return create('th', { scope: 'col', className }, label);
}

/** @param {Action} action */
function actionLink({ href = '', download, newWindow }) {
  const link = create('a', { href });
  if (download !== undefined) link.download = download;
  if (newWindow) [link.target, link.rel] = ['_blank', 'noopener'];
  return link;
}
