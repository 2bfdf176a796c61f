/** Keyboard navigation in tables: the rows are one tab stop, and the arrow keys move between them. */

/** @param {HTMLTableSectionElement} body each of its rows begins with a button */
export function navigateRows(body) {
  body.addEventListener('keydown', (event) => {
    const rows = [...body.rows];
    const place = rows.findIndex((row) => row.contains(document.activeElement));
    /** @type {Record<string, number>} */
    const targets = { ArrowDown: place + 1, ArrowUp: place - 1, Home: 0, End: rows.length - 1 };
    const target = targets[event.key];
    if (target === undefined || place < 0) return;
    event.preventDefault();
    event.stopPropagation();
    setTabStop(rows[Math.min(Math.max(target, 0), rows.length - 1)], true);
  });
}

/**
 * Makes a row the tab stop of its table and scrolls it into view.
 * @param {HTMLTableRowElement} row
 * @param {boolean} focus
 */
export function setTabStop(row, focus) {
  const [section, table] = [row.parentElement, row.closest('table')];
  const box = row.closest('.scroll');
  if (!section || !table || !box) return;
  /** @type {NodeListOf<HTMLElement>} */
  const controls = section.querySelectorAll('button, input');
  for (const control of controls) control.tabIndex = row.contains(control) ? 0 : -1;
  if (focus) row.querySelector('button')?.focus({ preventScroll: true });
  const [visible, position] = [box.getBoundingClientRect(), row.getBoundingClientRect()];
  const above = position.top - visible.top - (table.tHead?.offsetHeight ?? 0); // the head is sticky
  box.scrollTop += Math.min(0, above) + Math.max(0, position.bottom - visible.bottom);
}
