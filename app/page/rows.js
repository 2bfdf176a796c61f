/** The rows of a table as one stop of the tab key: the arrows go from one to the next. */

/** @param {HTMLTableSectionElement} body whose rows each begin with a button */
export function walk(body) {
  body.addEventListener('keydown', (event) => {
    const rows = [...body.rows];
    const place = rows.findIndex((row) => row.contains(document.activeElement));
    const to = { ArrowDown: place + 1, ArrowUp: place - 1, Home: 0, End: rows.length - 1 }[event.key];
    if (to === undefined || place < 0) return;
    event.preventDefault();
    event.stopPropagation();
    const row = rows[Math.min(Math.max(to, 0), rows.length - 1)];
    stopAt(row);
    row.querySelector('button').focus();
  });
}

/** Makes a row the one where the tab key stops. @param {HTMLTableRowElement} row */
export function stopAt(row) {
  for (const button of row.parentElement.querySelectorAll('button')) button.tabIndex = row.contains(button) ? 0 : -1;
}
