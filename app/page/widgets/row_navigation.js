/** The rows of a table as one stop of the tab key: the arrows go from one to the next. */

/** @param {HTMLTableSectionElement} body whose rows each begin with a button */
export function walk(body) {
  body.addEventListener('keydown', (event) => {
    const rows = [...body.rows];
    const place = rows.findIndex((row) => row.contains(document.activeElement));
    const to = { ArrowDown: place + 1, ArrowUp: place - 1, Home: 0, End: rows.length - 1 }[
      event.key
    ];
    if (to === undefined || place < 0) return;
    event.preventDefault();
    event.stopPropagation();
    stopAt(rows[Math.min(Math.max(to, 0), rows.length - 1)], true);
  });
}

/** Makes a row the one where the tab key stops, and brings it into sight. @param {HTMLTableRowElement} row @param {boolean} focus */
export function stopAt(row, focus) {
  for (const button of row.parentElement.querySelectorAll('button, input'))
    button.tabIndex = row.contains(button) ? 0 : -1;
  if (focus) row.querySelector('button').focus({ preventScroll: true });
  const box = row.closest('.scroll');
  const [seen, at] = [box.getBoundingClientRect(), row.getBoundingClientRect()];
  const above = at.top - seen.top - row.closest('table').tHead.offsetHeight; // the head stays where it is
  box.scrollTop += Math.min(0, above) + Math.max(0, at.bottom - seen.bottom);
}
