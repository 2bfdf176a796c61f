/** Scatter plot of two quantities of the rows of a sweep, or curves over the level of faults, as SVG; each point selects its row. */

/** @import { ExperimentRow } from '../types/server.js' */
/** @import { SeedGroup } from './experiment_groups.js' */

import { svgElement } from '../core/dom.js';
import { scaled } from '../core/colours.js';
import { fixed, niceStep, significant } from '../core/units.js';
import { colourOf, estimatorOf } from '../widgets/filter_colours.js';
import { extent, padded } from '../widgets/plots.js';
import { cellOf, faultLevel } from './experiment_groups.js';
import { numberOf, numbersOf } from './experiment_rows.js';

const MARGIN = { left: scaled(54), right: scaled(10), top: scaled(8), bottom: scaled(34) }; // px
const TICKS = 5;
const LINEAR_RATIO = 100;
const RADIUS = scaled(4);
const SMALLEST = scaled(80); // px

/** @typedef {ExperimentRow | SeedGroup} Row */
/**
 * x, y: names of the quantities; x can be `levelName` of one of the kinds of faults, whose levels are joined by lines. filters: their
 * order sets the colours.
 * @typedef {{x: string, y: string, kinds: string[], filters: string[], select: (row: Row) => void}} Choices
 */

/**
 * @param {HTMLElement} host
 * @param {Row[]} rows
 * @param {Choices} choices
 */
export function drawScatter(host, rows, choices) {
  const { kinds, filters, select } = choices;
  const kind = kinds.find((name) => levelName(name) === choices.x);
  const x = kind === undefined ? axis(rows, choices.x) : levelAxis(rows, kind);
  const y = axis(rows, choices.y);
  const [width, height] = [host.clientWidth, host.clientHeight];
  host.replaceChildren();
  if (!rows.length || width < SMALLEST || height < SMALLEST) return;
  const right = (/** @type {number} */ value) =>
    MARGIN.left + (width - MARGIN.left - MARGIN.right) * x.share(value);
  const up = (/** @type {number} */ value) =>
    height - MARGIN.bottom - (height - MARGIN.top - MARGIN.bottom) * y.share(value);
  const svg = svgElement('svg', { width, height, role: 'img' });
  svg.setAttribute(
    'aria-label',
    `${y.title} over ${x.title} of ${rows.length} results; the table has the values`,
  );
  for (const value of x.ticks)
    svg.append(
      line('grid', right(value), MARGIN.top, right(value), height - MARGIN.bottom),
      text(x.text(value), right(value), height - MARGIN.bottom + scaled(13), 'middle'),
    );
  for (const value of y.ticks)
    svg.append(
      line('grid', MARGIN.left, up(value), width - MARGIN.right, up(value)),
      text(y.text(value), MARGIN.left - scaled(5), up(value) + scaled(4), 'end'),
    );
  svg.append(text(x.title, (MARGIN.left + width) / 2, height - scaled(4), 'middle'));
  const side = text(y.title, 0, 0, 'middle');
  side.setAttribute('transform', `translate(${scaled(10)} ${height / 2}) rotate(-90)`);
  svg.append(side);
  const points = rows
    .map((row) => ({ row, a: x.value(row), b: y.value(row), dx: x.spread(row), dy: y.spread(row) }))
    .filter((point) => point.a !== null && point.b !== null)
    .map((point) => ({ ...point, a: Number(point.a), b: Number(point.b) }));
  if (kind !== undefined) {
    for (const curve of curves(points)) {
      const path = curve.map(({ a, b }) => `${right(a)},${up(b)}`).join(' ');
      const stroke = svgElement('polyline', { points: path, class: 'curve' });
      svg.append(coloured(stroke, curve[0].row, filters));
    }
  }
  for (const { row, a, b, dx, dy } of points) {
    const mark = (/** @type {SVGElement} */ shape) => svg.append(coloured(shape, row, filters));
    if (dx) mark(line('spread', right(a - dx), up(b), right(a + dx), up(b)));
    if (dy) mark(line('spread', right(a), up(b - dy), right(a), up(b + dy)));
    const point = svgElement('circle', {
      cx: right(a),
      cy: up(b),
      r: RADIUS,
      'data-cell': cellOf(row),
    });
    const [spreadX, spreadY] = [dx, dy].map((spread) =>
      spread ? ` ± ${significant(spread)}` : '',
    );
    point.append(
      svgElement(
        'title',
        {},
        `${row.name}${row.faults && `, ${row.faults}`}: ${significant(a)}${spreadX}, ${significant(b)}${spreadY}`,
      ),
    );
    point.addEventListener('click', () => select(row));
    mark(point);
  }
  host.replaceChildren(svg);
}

/**
 * Highlights the point of a row.
 * @param {HTMLElement} host
 * @param {string} cell
 */
export function markPoint(host, cell) {
  for (const point of host.querySelectorAll('circle'))
    point.classList.toggle('here', point.dataset.cell === cell);
}

/**
 * Points of the same checkpoints and data over the levels of the faults.
 * @template {{row: Row, a: number}} Point
 * @param {Point[]} points
 */
function curves(points) {
  /** @type {Map<string, Point[]>} */
  const result = new Map();
  for (const point of points) {
    const key = cellOf({ ...point.row, faults: '' });
    result.set(key, [...(result.get(key) ?? []), point]);
  }
  return [...result.values()].map((curve) => curve.sort((p, q) => p.a - q.a));
}

/**
 * Gives a mark the colour of its row's filter; particle filters are hollow.
 * @template {HTMLElement | SVGElement} Mark
 * @param {Mark} mark
 * @param {Row} row
 * @param {string[]} filters
 * @returns {Mark}
 */
export function coloured(mark, { filter }, filters) {
  mark.style.setProperty('--series', `var(${colourOf(filter, filters)})`);
  mark.classList.toggle('hollow', estimatorOf(filter, ['pf']) !== '');
  return mark;
}

/**
 * A quantity as an axis.
 * @param {Row[]} rows
 * @param {string} name
 */
function axis(rows, name) {
  const numbers = numbersOf(rows);
  const exists = name in numbers || rows.some((row) => numberOf(row, name) !== null);
  const key = exists ? name : 'error';
  const { title, hasUnit } = numbers[key] ?? { title: name, hasUnit: false };
  const units = [...new Set(rows.map(({ unit }) => unit))];
  return {
    title: hasUnit && units.length === 1 ? `${title}, ${units[0]}` : title,
    ...scale(
      rows,
      (row) => numberOf(row, key),
      (row) => ('spread' in row ? (row.spread[key] ?? 0) : 0),
    ),
  };
}

/**
 * The level of a kind of faults as an axis.
 * @param {Row[]} rows
 * @param {string} kind
 */
const levelAxis = (rows, kind) => ({
  title: `level of ${kind}`,
  ...scale(
    rows,
    (row) => faultLevel(row, kind),
    () => 0,
  ),
});

/** Name of the level of a kind of faults as the x axis. @param {string} kind */
export const levelName = (kind) => `level:${kind}`;

/**
 * Values, range and ticks of an axis, logarithmic if positive values differ by more than LINEAR_RATIO.
 * @param {Row[]} rows
 * @param {(row: Row) => number | null} value
 * @param {(row: Row) => number} spread standard deviation
 */
export function scale(rows, value, spread) {
  const centres = rows.map(value).filter((centre) => centre !== null);
  const [least, greatest] = extent(centres);
  const isLog = least > 0 && greatest > LINEAR_RATIO * least;
  const place = isLog ? Math.log10 : Number;
  const ends = rows.flatMap((row) => {
    const centre = value(row);
    return centre === null ? [] : [centre, centre - spread(row), centre + spread(row)];
  });
  const [low, high] = padded(extent(ends.filter((end) => !isLog || end > 0).map(place)));
  return { value, spread, ...(isLog ? powersOfTen : multiples)(low, high), share };

  /** Bars that reach below zero of a logarithmic axis end at its start. @param {number} point */
  function share(point) {
    return isLog && point <= 0 ? 0 : (place(point) - low) / (high - low);
  }
}

/**
 * Ticks at multiples of a nice step.
 * @param {number} low
 * @param {number} high
 */
function multiples(low, high) {
  const step = niceStep((high - low) / TICKS);
  const decimals = Math.max(0, -Math.floor(Math.log10(step)));
  const ticks = integers(low / step, high / step).map((i) => i * step);
  return { ticks, text: (/** @type {number} */ tick) => fixed(tick, decimals) };
}

/**
 * @param {number} low exponent
 * @param {number} high exponent
 */
const powersOfTen = (low, high) => ({
  ticks: integers(low, high).map((power) => 10 ** power),
  text: (/** @type {number} */ tick) => String(Number(tick.toPrecision(1))).replaceAll('-', '−'),
});

/**
 * The integers from low to high.
 * @param {number} low
 * @param {number} high
 */
const integers = (low, high) =>
  Array.from({ length: Math.floor(high) - Math.ceil(low) + 1 }, (_, i) => Math.ceil(low) + i);

/**
 * @param {string} className
 * @param {number} x1
 * @param {number} y1
 * @param {number} x2
 * @param {number} y2
 */
const line = (className, x1, y1, x2, y2) =>
  svgElement('line', { class: className, x1, y1, x2, y2 });

/**
 * @param {string} content
 * @param {number} x
 * @param {number} y
 * @param {string} anchor
 */
const text = (content, x, y, anchor) =>
  svgElement('text', { x, y, 'text-anchor': anchor }, content);
