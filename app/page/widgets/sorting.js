/** Sorting of table rows by a column. */

import { create, createButton } from '../core/dom.js';

/** @typedef {{name: string, down: boolean}} Sort column name and direction */

/**
 * Creates the heading of a sortable column.
 * @param {{name: string, title: string, help: string, number?: boolean}} column
 * @param {Sort} sort
 * @param {(sort: Sort) => void} apply called with the new order on a click
 * @param {boolean} [down] initial direction
 */
export function sortHeading({ name, title, help, number }, sort, apply, down = false) {
  const isSorted = sort.name === name;
  const press = () => apply({ name, down: isSorted ? !sort.down : down });
  const button = createButton('quiet sort', title, press, { title: `${help}. Click to sort` });
  button.dataset.part = `sort ${name}`; // to find it again when the head is redrawn
  const cell = create('th', { scope: 'col', className: number ? 'number' : '' }, button);
  cell.ariaSort = isSorted ? (sort.down ? 'descending' : 'ascending') : 'none';
  return cell;
}

/**
 * Returns sorted rows; those without a value are last. Numbers within texts sort by their values if `numeric` is set.
 * @template T
 * @param {T[]} rows
 * @param {(row: T) => string | number | null} value
 * @param {boolean} down
 * @param {boolean} [numeric]
 */
export function sortRows(rows, value, down, numeric = false) {
  const sign = down ? -1 : 1;
  return [...rows].sort((a, b) => {
    const [left, right] = [value(a), value(b)];
    if (left === null || right === null) return Number(left === null) - Number(right === null);
    if (typeof left === 'number') return sign * (left - Number(right));
    return sign * left.localeCompare(String(right), 'en', { numeric });
  });
}
