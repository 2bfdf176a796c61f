/** Sorting of table rows by a column. */

import { create } from '../core/dom.js';

/** @typedef {{name: string, down: boolean}} Sort column name and direction */

/**
 * Creates the heading of a sortable column.
 * @param {{name: string, title: string, help: string, number: boolean}} column
 * @param {Sort} sort
 * @param {(sort: Sort) => void} apply called with the new order on a click
 * @param {boolean} [down] initial direction
 */
export function sortHeading({ name, title, help, number }, sort, apply, down = false) {
  const button = create('button', {
    type: 'button',
    className: 'quiet sort',
    title: `${help}. Click to sort`,
    textContent: title,
  });
  const isSorted = sort.name === name;
  button.dataset.column = name;
  button.addEventListener('click', () => apply({ name, down: isSorted ? !sort.down : down }));
  const cell = create('th', { scope: 'col', className: number ? 'number' : '' }, button);
  cell.ariaSort = isSorted ? (sort.down ? 'descending' : 'ascending') : 'none';
  return cell;
}

/**
 * Returns sorted rows; those without a value are last.
 * @template T
 * @param {T[]} rows
 * @param {(row: T) => string | number | null} value
 * @param {boolean} down
 */
export function sortRows(rows, value, down) {
  const sign = down ? -1 : 1;
  return [...rows].sort((a, b) => {
    const [left, right] = [value(a), value(b)];
    if (left === null || right === null) return Number(left === null) - Number(right === null);
    return (
      sign * (typeof left === 'string' ? left.localeCompare(String(right)) : left - Number(right))
    );
  });
}
