/** Plots and pixel maps of a diagnostic: anything that is not a curve over the steps. */

/** @import { PixelMap, Plot } from '../types/server.js' */

import { create, paintPixels } from '../core/dom.js';
import {
  COLOUR_TABLES,
  colour,
  cssVariable,
  lineSample,
  lineStyle,
  scaled,
} from '../core/colours.js';
import { displayName, significant, typeset } from '../core/units.js';
import { LABEL, PLAIN, WHOLE_STEPS, axisStyle, clipToPlot } from '../timeline/plot_style.js';

/** @typedef {[low: number, high: number]} Range */
/** @typedef {{property: string, stroke: string, dash: number[], width: number}} LineStyle */

const PLOT_HEIGHT = scaled(190); // px
/** Dashes of the second line of a layer, the third, ... */
const DASHES = [
  [9, 3, 2, 3],
  [1.5, 3],
  [4, 2],
  [12, 4],
];
const [NAME_LENGTH, NAME_LINE] = [16, 15]; // of categories: characters in a line, px of its height
const MARGIN = 0.06; // of a range, above and below

/**
 * Draws a plot.
 * @param {HTMLElement} parent
 * @param {Plot} plot
 * @returns {uPlot}
 */
export function drawPlot(parent, plot) {
  const styles = lineStyles(plot.lines);
  const head = heading(plot.title);
  plot.lines.forEach(({ name }, i) => name && head.append(legendEntry(styles[i], name)));
  const canvas = create('div', { className: 'canvas', role: 'img' });
  canvas.ariaLabel = `${plot.title}: ${plot.y_label} over ${plot.x_label}`;
  const figure = create('figure', {}, head, canvas);
  figure.classList.toggle('wide', Boolean(plot.names?.length)); // names need room
  parent.append(figure);
  const xs = plot.lines.flatMap((line) => line.x);
  const barWidth = plot.kind === 'bars' ? smallestDistance(xs) : 0;
  const [x, y] = ranges(plot, barWidth);
  const chart = new uPlot(
    {
      width: figure.clientWidth,
      height: PLOT_HEIGHT,
      padding: [4, 10, 0, 0],
      ...PLAIN,
      scales: {
        x: { time: false, range: () => (x[1] > x[0] ? x : [x[0] - 1, x[0] + 1]) },
        y: { range: () => y },
      },
      axes: [
        {
          ...axisStyle(),
          ...LABEL,
          label: typeset(plot.x_label),
          size: scaled(16),
          gap: 2,
          space: scaled(40),
          ...(xs.every(Number.isInteger) ? { incrs: WHOLE_STEPS } : {}),
          ...(plot.names?.length ? namedTicks(plot.names) : {}),
        },
        {
          ...axisStyle(),
          ...LABEL,
          label: typeset(plot.y_label),
          size: scaled(40),
          gap: 3,
          space: scaled(24),
        },
      ],
      series: [{}, { show: false }],
      hooks: { draw: [(self) => drawLines(self, plot, styles, barWidth)] },
    },
    [x, [null, null]],
    canvas,
  );
  chart.over.addEventListener('pointermove', ({ offsetX, offsetY }) => {
    const [left, top] = [chart.posToVal(offsetX, 'x'), chart.posToVal(offsetY, 'y')];
    canvas.title = `${significant(left)}, ${significant(top)}`;
  });
  return chart;
}

/**
 * Draws one value per pixel with a colour bar, and shows the value under the pointer.
 * @param {PixelMap} map
 */
export function drawPixelMap({ title, values, unit, signed }) {
  const [height, width] = [values.length, values[0].length];
  const [minimum, maximum] = extent(values.flat());
  const limit = Math.max(Math.abs(minimum), Math.abs(maximum)) || 1;
  const low = signed ? -limit : minimum;
  const high = signed ? limit : maximum > minimum ? maximum : minimum + 1;
  const table = signed ? COLOUR_TABLES.diverging : COLOUR_TABLES.viridis;
  const canvas = create('canvas', { width, height, role: 'img' });
  canvas.ariaLabel = `${title}: from ${significant(minimum)} to ${significant(maximum)} ${unit}`;
  paintPixels(
    canvas,
    values
      .flat()
      .map((v) => (v === null ? 0 : table[Math.round((255 * (v - low)) / (high - low))])),
  );
  const colourBar = create('canvas', { width: 256, height: 1, className: 'bar-of-colours' });
  paintPixels(colourBar, table);
  const scale = create('span', {}, significant(low), colourBar, `${significant(high)} ${unit}`);
  const output = document.createElement('output');
  canvas.addEventListener('pointermove', ({ offsetX, offsetY }) => {
    const column = Math.floor((offsetX / canvas.clientWidth) * width);
    const row = Math.floor((offsetY / canvas.clientHeight) * height);
    const value = values[row]?.[column];
    output.textContent =
      value === undefined ? '' : `column ${column}, row ${row}: ${significant(value)} ${unit}`;
  });
  canvas.addEventListener('pointerleave', () => (output.textContent = ''));
  const caption = create('figcaption', {}, scale, output);
  return create('figure', { className: 'pixel-map' }, heading(title), canvas, caption);
}

/** Text for display, with spaces in joined names such as image+haptics, not in numbers. @param {string} text */
export const label = (text) =>
  typeset(displayName(text)).replace(/(?<=[\p{L}\d])\+(?=\p{L})/gu, ' + ');

/** @param {string} title */
export const heading = (title) =>
  create('div', { className: 'head' }, create('h4', { textContent: label(title) }));

/**
 * Creates the legend entry of a line, with its current value if it has one.
 * @param {LineStyle} style
 * @param {string} name
 * @param {HTMLElement} [value]
 */
export function legendEntry({ property, dash, width }, name, value) {
  const sample = lineSample(property, dash, width);
  return create('span', { className: 'line' }, sample, label(name), ...(value ? [' ', value] : []));
}

/**
 * Returns the styles of lines: the layer sets the colour, the dash distinguishes the lines of a layer.
 * @param {{layer: string}[]} lines
 * @returns {LineStyle[]}
 */
export function lineStyles(lines) {
  /** @type {Map<string, number>} */
  const counts = new Map();
  return lines.map(({ layer }) => {
    const n = counts.get(layer) ?? 0;
    counts.set(layer, n + 1);
    const { stroke, dash, width } = layer
      ? lineStyle(layer)
      : { stroke: colour('ink'), dash: [], width: 1.5 };
    return {
      property: layer ? cssVariable(layer) : '--ink',
      stroke,
      dash: n ? DASHES[(n - 1) % DASHES.length] : dash,
      width: n ? 1.5 : width,
    };
  });
}

/**
 * Returns the ticks of categories, whose names are wrapped.
 * @param {string[]} names
 */
function namedTicks(names) {
  const texts = names.map((name) => wrapped(name, NAME_LENGTH));
  const lines = Math.max(...texts.map((text) => text.split('\n').length));
  return {
    space: 1,
    size: scaled(4 + NAME_LINE * lines),
    values: (/** @type {uPlot} */ _, /** @type {number[]} */ splits) =>
      splits.map((value) => texts[value] ?? ''),
  };
}

/**
 * Breaks a text between words into lines of a length, which longer words exceed.
 * @param {string} text
 * @param {number} length characters
 */
export function wrapped(text, length) {
  /** @type {string[]} */
  const lines = [];
  for (const word of text.split(' ')) {
    const longer = lines.length ? `${lines[lines.length - 1]} ${word}` : word;
    if (lines.length && longer.length <= length) lines[lines.length - 1] = longer;
    else lines.push(word);
  }
  return lines.join('\n');
}

/**
 * Returns the smallest and the largest finite value.
 * @param {(number | null)[]} values
 * @returns {Range}
 */
export function extent(values) {
  let [low, high] = [Infinity, -Infinity];
  for (const value of values) {
    if (value === null || !Number.isFinite(value)) continue;
    low = Math.min(low, value);
    high = Math.max(high, value);
  }
  return Number.isFinite(low) ? [low, high] : [0, 1];
}

/**
 * Adds margins to a range.
 * @param {Range} range
 * @returns {Range}
 */
export function padded([low, high]) {
  const margin = MARGIN * (high - low) || Math.abs(high) / 10 || 1;
  return [low === 0 ? -margin / 4 : low - margin, high + margin];
}

/**
 * Returns the ranges of both axes.
 * @param {Plot} plot
 * @param {number} barWidth
 * @returns {[x: Range, y: Range]}
 */
function ranges({ lines, kind, diagonal }, barWidth) {
  const ideal = diagonal ? [0, 1] : [];
  const [low, high] = extent([...lines.flatMap((line) => line.x), ...ideal]);
  const zero = kind === 'bars' ? [0] : [];
  const y = padded(extent([...lines.flatMap((line) => line.y), ...ideal, ...zero]));
  if (kind === 'bars') return [[low - 0.6 * barWidth, high + 0.6 * barWidth], y];
  return [kind === 'points' ? padded([low, high]) : [low, high], y];
}

/** @param {(number | null)[]} xs */
function smallestDistance(xs) {
  const sorted = [...new Set(xs)].map(Number).sort((a, b) => a - b);
  if (sorted.length < 2) return 1;
  return Math.min(...sorted.slice(1).map((x, i) => x - sorted[i]));
}

/**
 * Draws the lines, points or bars of a plot.
 * @param {uPlot} chart
 * @param {Plot} plot
 * @param {LineStyle[]} styles
 * @param {number} barWidth
 */
function drawLines(chart, { lines, kind, diagonal }, styles, barWidth) {
  const { ctx } = chart;
  const x = (/** @type {number} */ value) => chart.valToPos(value, 'x', true);
  const y = (/** @type {number} */ value) => chart.valToPos(value, 'y', true);
  clipToPlot(chart);
  if (diagonal) {
    strokePath(ctx, { stroke: colour('muted'), dash: [4, 3], width: 1 }, [
      [x(0), y(0)],
      [x(1), y(1)],
    ]);
  }
  lines.forEach((line, i) => {
    ctx.fillStyle = styles[i].stroke;
    const points = finitePoints(line);
    if (kind === 'line') {
      strokePath(
        ctx,
        styles[i],
        points.map(([px, py]) => [x(px), y(py)]),
      );
    } else if (kind === 'points') {
      for (const [px, py] of points) {
        ctx.beginPath();
        ctx.arc(x(px), y(py), 1.6 * devicePixelRatio, 0, 2 * Math.PI);
        ctx.fill();
      }
    } else {
      const width = (0.8 * barWidth) / lines.length;
      for (const [px, py] of points) {
        const left = px + (i - lines.length / 2) * width;
        const pixels = 0.9 * (x(left + width) - x(left));
        ctx.fillRect(x(left), y(Math.max(py, 0)), pixels, Math.abs(y(py) - y(0)));
      }
    }
  });
  ctx.restore();
}

/**
 * @param {{x: (number | null)[], y: (number | null)[]}} line
 * @returns {[number, number][]}
 */
function finitePoints({ x, y }) {
  /** @type {[number, number][]} */
  const points = [];
  x.forEach((value, i) => {
    const other = y[i];
    if (value !== null && other !== null && Number.isFinite(value) && Number.isFinite(other))
      points.push([value, other]);
  });
  return points;
}

/**
 * @param {CanvasRenderingContext2D} ctx
 * @param {Pick<LineStyle, 'stroke' | 'dash' | 'width'>} style
 * @param {[x: number, y: number][]} points px
 */
function strokePath(ctx, { stroke, dash, width }, points) {
  ctx.strokeStyle = stroke;
  ctx.lineWidth = width * devicePixelRatio;
  ctx.setLineDash(dash.map((length) => length * devicePixelRatio));
  ctx.beginPath();
  points.forEach(([x, y], i) => (i ? ctx.lineTo(x, y) : ctx.moveTo(x, y)));
  ctx.stroke();
}
