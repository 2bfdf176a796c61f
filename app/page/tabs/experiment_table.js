/** The table of the Experiments tab: one row for each result or group, with columns that can be sorted and pinned. */

/** @import { ExperimentRow } from '../types/server.js' */
/** @import { Sort } from '../widgets/sorting.js' */
/** @import { Column } from './experiment_columns.js' */
/** @import { SeedGroup } from './experiment_groups.js' */
/** @typedef {{rows: (ExperimentRow | SeedGroup)[], columns: Column[], pinned: string[], sort: Sort, filters: string[]}} Contents */

import { create, createButton, element } from '../core/dom.js';
import { navigateRows, setTabStop } from '../widgets/row_navigation.js';
import { sortHeading } from '../widgets/sorting.js';
import { cellOf } from './experiment_groups.js';
import { isAddress } from './experiment_provenance.js';
import { coloured } from './scatter.js';

const ROWS_AT_ONCE = 200; // drawn before the table is scrolled

export class ExperimentTable {
  #table;
  #body;
  #on;
  /** @type {Contents} */
  #contents = { rows: [], columns: [], pinned: [], sort: { name: '', down: false }, filters: [] };

  /**
   * @param {HTMLElement} host scrolls, and contains the table
   * @param {object} on
   * @param {(row: ExperimentRow | SeedGroup) => void} on.select called for a pressed row
   * @param {(sort: Sort) => void} on.sort called for a pressed heading
   * @param {(names: string[]) => void} on.pin called with the keys of the columns to pin
   */
  constructor(host, on) {
    this.#on = on;
    this.#table = element('.checkpoints', HTMLTableElement, host);
    this.#body = element('tbody', HTMLTableSectionElement, this.#table);
    navigateRows(this.#body);
    host.addEventListener('scroll', () => {
      const below = host.scrollHeight - host.scrollTop - host.clientHeight;
      if (below < host.clientHeight) this.#addRows(ROWS_AT_ONCE);
    });
  }

  /**
   * Draws the headings and the first rows.
   * @param {Contents} contents rows in order; the order of `filters` sets the colours
   */
  draw(contents) {
    this.#contents = contents;
    const { columns, sort } = contents;
    const heads = columns.map(({ key, title, help, number }, i) => {
      const head = sortHeading({ name: key, title, help, number }, sort, this.#on.sort, number);
      // beside the title, at the side away from the values' edge
      if (i > 0) head[number ? 'prepend' : 'append'](this.#pinButton(key, title));
      return head;
    });
    element('thead', HTMLTableSectionElement, this.#table).replaceChildren(
      create('tr', {}, ...heads),
    );
    this.#body.replaceChildren();
    this.#addRows(ROWS_AT_ONCE);
  }

  /**
   * Marks the row of a result or group, which is drawn if it was not.
   * @param {string} cell
   */
  mark(cell) {
    const missing = this.#contents.rows.findIndex((row) => cellOf(row) === cell) + 1;
    this.#addRows(Math.max(0, missing - this.#body.rows.length));
    for (const line of this.#body.rows) {
      const here = line.dataset.cell === cell;
      line.classList.toggle('here', here);
      if (here) setTabStop(line, false);
    }
  }

  /**
   * Adds the next rows to the table, which has the first ones until it is scrolled.
   * @param {number} count
   */
  #addRows(count) {
    const drawn = this.#body.rows.length;
    const lines = this.#contents.rows.slice(drawn, drawn + count).map((row) => this.#row(row));
    this.#body.append(...lines);
    if (lines.length) this.#stick();
  }

  /**
   * @param {string} key
   * @param {string} title
   */
  #pinButton(key, title) {
    const { pinned } = this.#contents;
    const isPinned = pinned.includes(key);
    const toggle = () => {
      const others = pinned.filter((name) => name !== key);
      this.#on.pin(isPinned ? others : [...others, key]);
    };
    return createButton('quiet pin', '⇤', toggle, {
      title: isPinned ? 'Unpin this column' : 'Pin this column at the left',
      ariaLabel: `Pin ${title}`,
      ariaPressed: String(isPinned),
    });
  }

  /** Keeps the first column and those pinned at the left of the table when it scrolls. */
  #stick() {
    const { columns, pinned } = this.#contents;
    const count = columns.filter(({ key }) => pinned.includes(key)).length;
    const lines = [...this.#table.rows];
    const widths = [...lines[0].cells].slice(0, count).map((cell) => cell.offsetWidth);
    for (const line of lines)
      widths.reduce((left, width, i) => {
        const cell = line.cells[i + 1];
        cell.classList.add('pinned');
        cell.style.left = `${left + width}px`;
        return left + width;
      }, 0);
  }

  /** @param {ExperimentRow | SeedGroup} row */
  #row(row) {
    const { columns, filters } = this.#contents;
    const button = create('button', { type: 'button', className: 'quiet', textContent: row.name });
    button.title = `${row.name}: its worst episodes`;
    const dot = coloured(create('span', { className: 'dot' }), row, filters);
    const line = create('tr', {}, create('th', { scope: 'row' }, dot, button));
    line.dataset.cell = cellOf(row);
    line.addEventListener('click', () => this.#on.select(row)); // also clicks on the button, which serves the keyboard
    for (const { content, number } of columns.slice(1)) {
      const cell = line.insertCell();
      cell.className = number ? 'number' : '';
      const text = content(row);
      if (isAddress(text)) cell.append(externalLink(text));
      else cell.textContent = text;
    }
    return line;
  }
}

/** @param {string} address */
function externalLink(address) {
  const textContent = address.replace(/^https?:\/\//, '');
  const link = create('a', { href: address, target: '_blank', rel: 'noopener', textContent });
  link.addEventListener('click', (event) => event.stopPropagation()); // does not select the row
  return link;
}
