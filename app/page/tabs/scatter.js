/** Scatter plot of two quantities of the rows of a sweep, as SVG; each point selects its row. */

/** @import { ExperimentRow } from '../types/server.js' */
/** @import { NumberKey } from './experiment_rows.js' */

import { scaled } from '../core/palette.js';
import { fixed, significant } from '../core/units.js';
import { extent, padded } from '../widgets/plots.js';
import { NUMBERS, rowKey } from './experiment_rows.js';

const SVG = 'http://www.w3.org/2000/svg';
const MARGIN = { left: scaled(44), right: scaled(10), top: scaled(8), bottom: scaled(34) }; // px
const TICKS = 5;
const COLOURS = 6; // in experiments.css
const RADIUS = scaled(4);
const SMALLEST = scaled(80); // px

/**
 * @param {HTMLElement} host
 * @param {ExperimentRow[]} rows
 * @param {string} xKey
 * @param {string} yKey
 * @param {string[]} filters their order sets the colours
 * @param {string} selected key of the selected row
 * @param {(row: ExperimentRow) => void} select
 */
export function drawScatter(host, rows, xKey, yKey, filters, selected, select) {
  const [x, y] = [axis(rows, xKey), axis(rows, yKey)];
  const [width, height] = [host.clientWidth, host.clientHeight];
  host.replaceChildren();
  if (!rows.length || width < SMALLEST || height < SMALLEST) return;
  const right = (/** @type {number} */ value) =>
    MARGIN.left + (width - MARGIN.left - MARGIN.right) * x.share(value);
  const up = (/** @type {number} */ value) =>
    height - MARGIN.bottom - (height - MARGIN.top - MARGIN.bottom) * y.share(value);
  const svg = node('svg', { width, height, role: 'img' });
  svg.setAttribute(
    'aria-label',
    `${y.title} over ${x.title} of ${rows.length} results; the table has the values`,
  );
  for (const value of x.ticks)
    svg.append(
      node('line', {
        class: 'grid',
        x1: right(value),
        x2: right(value),
        y1: MARGIN.top,
        y2: height - MARGIN.bottom,
      }),
      text(fixed(value, x.decimals), right(value), height - MARGIN.bottom + scaled(13), 'middle'),
    );
  for (const value of y.ticks)
    svg.append(
      node('line', {
        class: 'grid',
        x1: MARGIN.left,
        x2: width - MARGIN.right,
        y1: up(value),
        y2: up(value),
      }),
      text(fixed(value, y.decimals), MARGIN.left - scaled(5), up(value) + scaled(4), 'end'),
    );
  svg.append(text(x.title, (MARGIN.left + width) / 2, height - scaled(4), 'middle'));
  const side = text(y.title, 0, 0, 'middle');
  side.setAttribute('transform', `translate(${scaled(10)} ${height / 2}) rotate(-90)`);
  svg.append(side);
  for (const row of rows) {
    const [a, b] = [row[x.key], row[y.key]];
    if (a === null || b === null) continue;
    const point = node('circle', { cx: right(a), cy: up(b), r: RADIUS, 'data-cell': rowKey(row) });
    point.setAttribute('class', seriesOf(row, filters));
    point.classList.toggle('here', rowKey(row) === selected);
    const label = document.createElementNS(SVG, 'title');
    label.textContent = `${row.name}${row.faults && `, ${row.faults}`}: ${significant(a)}, ${significant(b)}`;
    point.append(label);
    point.addEventListener('click', () => select(row));
    svg.append(point);
  }
  host.replaceChildren(svg);
}

/**
 * Class of the points of a filter.
 * @param {ExperimentRow} row
 * @param {string[]} filters
 */
export const seriesOf = ({ filter }, filters) => `series-${filters.indexOf(filter) % COLOURS}`;

/**
 * Range, ticks and title of an axis.
 * @param {ExperimentRow[]} rows
 * @param {string} name
 */
function axis(rows, name) {
  const key = /** @type {NumberKey} */ (name in NUMBERS ? name : 'error');
  const [low, high] = padded(extent(rows.map((row) => row[key])));
  const step = niceStep((high - low) / TICKS);
  const first = Math.ceil(low / step);
  const count = Math.floor(high / step) - first + 1;
  const { title, hasUnit } = NUMBERS[key];
  const units = [...new Set(rows.map(({ unit }) => unit))];
  return {
    key,
    title: hasUnit && units.length === 1 ? `${title}, ${units[0]}` : title,
    ticks: Array.from({ length: count }, (_, i) => (first + i) * step),
    decimals: Math.max(0, -Math.floor(Math.log10(step))),
    share: (/** @type {number} */ value) => (value - low) / (high - low),
  };
}

/** The smallest of 1, 2 and 5 times a power of ten that is at least this. @param {number} step */
export function niceStep(step) {
  const power = 10 ** Math.floor(Math.log10(step));
  return power * ([1, 2, 5].find((factor) => factor * power >= step) ?? 10);
}

/**
 * @param {string} name
 * @param {Record<string, string | number>} attributes
 */
function node(name, attributes) {
  const result = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) result.setAttribute(key, String(value));
  return result;
}

/**
 * @param {string} content
 * @param {number} x
 * @param {number} y
 * @param {string} anchor
 */
function text(content, x, y, anchor) {
  const result = node('text', { x, y, 'text-anchor': anchor });
  result.textContent = content;
  return result;
}
