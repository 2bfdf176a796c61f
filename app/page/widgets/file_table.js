/** A table of files that can be sorted: each has a name that opens it, a field to change what it is called, and a menu. */

import { stopAt, walk } from './row_navigation.js';

/**
 * @typedef {{name: string}} File
 * @typedef {object} Column
 * @property {string} name @property {string} title @property {string} help
 * @property {(file: File) => string | number | null} value by which it is sorted; null where there is none
 * @property {(file: File) => string | Node} shown @property {(file: File) => string} [hint] @property {boolean} [number]
 * @typedef {object} Act what can be done with a file
 * @property {string} name @property {string} [key] of the keyboard that does it in its row
 * @property {() => void} [act] @property {string} [href] a link in its place, `download` a name to save it by, `window` whether in another one
 * @property {string} [why] it cannot be done @property {string} [hint] what there is to know
 */

export class FileTable {
  #table;
  #menu = Object.assign(document.createElement('div'), { popover: 'auto', className: 'menu' });
  #columns;
  #acts;
  #picks;
  #sort;
  #files = [];
  #rows = new Map(); // by name
  #editing = false;
  #here = '';

  /**
   * @param {HTMLTableElement} table @param {Column[]} columns the first is the name's
   * @param {{acts: (file: File) => Act[], sort: {name: string, down: boolean}, picks?: {has: (name: string) => boolean, toggle: (name: string) => void}}} ways
   *   the first of a file's acts is what a click on its name does; `picks` gives each row a box to tick
   */
  constructor(table, columns, { acts, sort, picks = null }) {
    [this.#table, this.#columns, this.#acts, this.#sort, this.#picks] = [
      table,
      columns,
      acts,
      sort,
      picks,
    ];
    this.#menu.setAttribute('role', 'menu');
    table.parentElement.append(this.#menu);
    this.#menu.addEventListener('keydown', (event) => this.#roam(event));
    walk(table.tBodies[0]);
    table.tBodies[0].addEventListener('keydown', (event) => this.#press(event));
  }

  /** @param {File[]} files What is being written in a field stays; the rest follows when that is done. */
  show(files) {
    this.#files = files;
    if (!this.#editing) this.#draw();
  }

  /** Marks a file's row and brings it into sight. */
  point(name) {
    this.#here = name;
    for (const [other, row] of this.#rows) row.classList.toggle('here', other === name);
    if (this.#rows.has(name)) stopAt(this.#rows.get(name), true);
  }

  /** A field in place of a file's name. @param {(text: string) => Promise<void>} save says by an error what is wrong */
  edit(file, label, text, save) {
    const cell = this.#rows.get(file.name)?.querySelector('.name');
    if (!cell) return;
    const form = document.createElement('form');
    form.innerHTML =
      '<input type="text" autocomplete="off" spellcheck="false"><p class="wrong" role="alert"></p>';
    const [input, wrong] = form.children;
    [input.value, input.ariaLabel] = [text, label];
    this.#editing = true;
    const end = () => {
      if (!this.#editing) return;
      this.#editing = false;
      this.#draw();
      const row = this.#rows.get(file.name) ?? this.#rows.get(this.#here); // it may have another name by now
      if (row) stopAt(row, true);
    };
    const done = async () => {
      if (input.value === text) return end();
      input.disabled = true;
      try {
        await save(input.value);
        end();
      } catch (error) {
        [input.disabled, wrong.textContent] = [false, error.message];
        input.setAttribute('aria-invalid', 'true');
        input.focus();
      }
    };
    form.addEventListener('submit', (event) => (event.preventDefault(), done()));
    form.addEventListener('keydown', (event) => {
      event.stopPropagation();
      if (event.key === 'Escape') end();
    });
    form.addEventListener('focusout', () => !input.disabled && !wrong.textContent && done());
    cell.replaceChildren(form);
    input.focus();
    input.select();
  }

  get #ordered() {
    const { value } = this.#columns.find(({ name }) => name === this.#sort.name);
    const sign = this.#sort.down ? -1 : 1;
    const order = (a, b) =>
      typeof a === 'string' ? a.localeCompare(b, 'en', { numeric: true }) : a - b;
    return [...this.#files].sort((a, b) => {
      const [one, other] = [value(a), value(b)];
      return one === null || other === null
        ? Number(one === null) - Number(other === null)
        : sign * order(one, other);
    });
  }

  #draw() {
    const { activeElement: active } = document;
    const [focused, part] = this.#table.contains(active)
      ? [active.closest('tr')?.dataset.name, active.dataset.part]
      : [];
    const top = document.createElement('tr');
    if (this.#picks) top.append(unseen('Chosen', 'pick'));
    top.append(...this.#columns.map((column) => this.#heading(column)), unseen('Menu', 'menus'));
    this.#table.tHead.replaceChildren(top);
    const files = this.#ordered;
    this.#rows = new Map(files.map((file, i) => [file.name, this.#row(file, i)]));
    this.#table.tBodies[0].replaceChildren(...this.#rows.values());
    this.#table.hidden = !files.length;
    const again = focused !== undefined ? this.#rows.get(focused) : part && this.#table.tHead;
    if (again && focused !== undefined) stopAt(again, false);
    again?.querySelector?.(`[data-part="${part}"]`)?.focus({ preventScroll: true });
  }

  #heading({ name, title, help, number }) {
    const cell = Object.assign(document.createElement('th'), {
      scope: 'col',
      className: `${number ? 'number ' : ''}of-${name}`,
    });
    const sorted = this.#sort.name === name;
    cell.ariaSort = sorted ? (this.#sort.down ? 'descending' : 'ascending') : 'none';
    const button = part('button', `sort ${name}`, {
      type: 'button',
      className: 'quiet sort',
      title: `${help}. Sort by it`,
      textContent: title,
    });
    button.addEventListener('click', () => {
      this.#sort = { name, down: sorted ? !this.#sort.down : Boolean(number) };
      this.#draw();
    });
    cell.append(button);
    return cell;
  }

  #row(file, i) {
    const row = document.createElement('tr');
    row.dataset.name = file.name;
    row.classList.toggle('here', file.name === this.#here);
    const acts = this.#acts(file);
    if (this.#picks) {
      const pick = part('input', 'pick', {
        type: 'checkbox',
        checked: this.#picks.has(file.name),
        ariaLabel: `Choose ${file.name}`,
      });
      pick.addEventListener('change', () => this.#picks.toggle(file.name));
      row.insertCell().append(pick);
      row.cells[0].className = 'pick';
    }
    for (const [c, { name, shown, hint, number }] of this.#columns.entries()) {
      const cell = row.insertCell();
      cell.className = c ? `${number ? 'number ' : ''}of-${name}` : 'name';
      cell.title = hint?.(file) ?? '';
      const place = c ? cell : cell.appendChild(document.createElement('div'));
      if (!c) place.append(this.#opener(file, acts[0]));
      place.append(shown(file));
    }
    const more = part('button', 'more', {
      type: 'button',
      className: 'quiet more',
      textContent: '⋯',
      ariaHasPopup: 'menu',
      title: 'What can be done with it',
    });
    more.setAttribute('aria-label', `Menu of ${file.name}`);
    more.addEventListener('click', () => this.#unfold(more, acts));
    row.insertCell().append(more);
    for (const control of row.querySelectorAll('button, input')) control.tabIndex = i ? -1 : 0;
    return row;
  }

  #opener(file, { name, why }) {
    const button = part('button', 'open', {
      type: 'button',
      className: 'title',
      textContent: file.name,
    });
    button.title = why ?? `${name}: ${file.name}`;
    button.setAttribute('aria-disabled', String(Boolean(why)));
    button.addEventListener('click', () => this.#do(file, ({ name: other }) => other === name));
    return button;
  }

  #do(file, which) {
    const found = this.#acts(file).find(which);
    if (!found || found.why) return;
    if (found.href) link(found).click();
    else found.act();
  }

  #press(event) {
    const file = this.#files.find(({ name }) => name === event.target.closest('tr')?.dataset.name);
    if (!file || event.target.closest('form')) return;
    if (event.key === 'Enter' || !this.#acts(file).some(({ key }) => key === event.key)) return; // its button has Enter
    event.preventDefault();
    event.stopPropagation();
    this.#do(file, ({ key }) => key === event.key);
  }

  #unfold(button, acts) {
    this.#menu.replaceChildren(...acts.map((act) => this.#item(act)));
    this.#menu.showPopover();
    const [at, size] = [button.getBoundingClientRect(), this.#menu.getBoundingClientRect()];
    this.#menu.style.left = `${Math.max(4, Math.min(at.right - size.width, innerWidth - size.width - 4))}px`;
    this.#menu.style.top = `${at.bottom + size.height > innerHeight - 4 ? Math.max(4, at.top - size.height) : at.bottom}px`;
    this.#menu.firstElementChild.focus();
  }

  #item(act) {
    const item =
      act.href && !act.why
        ? link(act)
        : Object.assign(document.createElement('button'), { type: 'button' });
    item.setAttribute('role', 'menuitem');
    item.setAttribute('aria-disabled', String(Boolean(act.why)));
    item.tabIndex = -1;
    item.append(Object.assign(document.createElement('span'), { textContent: act.name }));
    if (act.key)
      item.append(
        Object.assign(document.createElement('kbd'), {
          textContent: { Delete: 'del' }[act.key] ?? act.key,
        }),
      );
    if (act.why ?? act.hint)
      item.append(
        Object.assign(document.createElement('small'), { textContent: act.why ?? act.hint }),
      );
    item.addEventListener('click', () => {
      if (act.why) return;
      this.#menu.hidePopover();
      act.act?.();
    });
    return item;
  }

  #roam(event) {
    event.stopPropagation();
    const items = [...this.#menu.children];
    const place = items.indexOf(document.activeElement);
    const to = { ArrowDown: place + 1, ArrowUp: place - 1, Home: 0, End: -1 }[event.key];
    if (event.key === 'Tab') this.#menu.hidePopover();
    if (to === undefined) return;
    event.preventDefault();
    items.at(to % items.length).focus();
  }
}

/** The heading of a column whose cells say by themselves what they are. */
function unseen(text, className) {
  const cell = Object.assign(document.createElement('th'), { scope: 'col', className });
  cell.append(
    Object.assign(document.createElement('span'), {
      className: 'visually-hidden',
      textContent: text,
    }),
  );
  return cell;
}

function link({ href, download, window }) {
  return Object.assign(document.createElement('a'), {
    href,
    ...(download !== undefined && { download }),
    ...(window && { target: '_blank', rel: 'noopener' }),
  });
}

/** An element that is found again when its row is made anew. */
function part(tag, name, properties) {
  const made = Object.assign(document.createElement(tag), properties);
  made.dataset.part = name;
  return made;
}
