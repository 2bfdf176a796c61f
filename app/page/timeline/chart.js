/** One track of the time line: a uPlot chart without cursor, legend or axis of its own, with shaded stretches. */

import { colour, em, line, translucent } from '../core/palette.js';

/**
 * @typedef {object} Series
 * @property {string} name truth, fused, a modality @property {ArrayLike<number>} values
 * @property {ArrayLike<number>} [sigma] draws a band of two of them on either side
 * @property {boolean} [other] of the trace that is drawn over the first
 * @typedef {object} Track
 * @property {string} title @property {string} unit @property {string} [help] what it is @property {Series[]} series
 * @property {[number, number]} [limits] of the y axis; fitted to what is in view otherwise
 * @property {boolean} [fromZero] @property {boolean} [log] whether the y axis is logarithmic
 * @property {[number, number]} [bounds] between which values should be
 * @property {number} [digits] of the values in the legend; three that are significant otherwise
 * @property {string} [note] said in place of a plot
 * @typedef {{contact: [number, number][], black: [number, number][], edit?: [number, number][]}} Shading stretches of steps
 */

/** px beside and below a track's plot. */
export const GUTTER = { left: em(46), right: em(12), axis: em(33) };
const BLACK_STRIP = em(8); // px
const LOWEST = 0.1; // of the lower bound: a logarithmic axis goes no further down
export const FONT = `${em(10)}px system-ui, sans-serif`;
/** An axis's name. */
export const LABEL = { labelSize: em(14), labelGap: 0, labelFont: FONT };

/** How a line is drawn. Where two traces are compared, the first's lines are whole and the other's dashed. */
export function style({ name, other = false }, compared) {
  const own = line(name);
  if (!compared) return own;
  return other ? { ...own, dash: [5, 4], width: Math.min(own.width, 1.75) } : { ...own, dash: [] };
}

/**
 * @param {HTMLElement} parent @param {Track} track @param {Shading} shading
 * @param {object} frame
 * @param {number} frame.width @param {number} frame.height px @param {() => [number, number]} frame.window steps in view
 * @param {number} frame.steps @param {boolean} frame.withAxis @param {string} frame.stepName
 * @param {boolean} frame.compared whether another trace is drawn over the first
 * @returns {uPlot}
 */
export function chart(parent, track, shading, frame) {
  const ink = { stroke: colour('muted'), grid: { stroke: colour('grid'), width: 1, show: !track.note }, ticks: { stroke: colour('grid'), size: 4, width: 1 }, font: FONT };
  const series = [{}];
  const bands = [];
  for (const { name, sigma } of track.series) {
    if (!sigma) continue;
    const edge = { points: { show: false }, width: 0, stroke: 'transparent' };
    series.push({ ...edge }, { ...edge });
    bands.push({ series: [series.length - 2, series.length - 1], fill: translucent(line(name).stroke, name === 'fused' ? 0.2 : 0.08) });
  }
  for (const one of track.series) series.push({ ...style(one, frame.compared), points: { show: false } });
  if (!track.series.length) series[1] = {}; // an axis needs a line
  return new uPlot(
    {
      width: frame.width,
      height: frame.height,
      padding: [4, GUTTER.right, frame.withAxis ? 0 : 4, 0],
      cursor: { show: false },
      legend: { show: false },
      select: { show: false },
      scales: {
        x: { time: false, range: () => frame.window() },
        y: { distr: track.log ? 3 : 1, range: () => track.limits ?? (track.note ? [0, 1] : fitted(track, frame.window())) },
      },
      axes: [
        stepAxis(ink, frame),
        { ...ink, size: GUTTER.left, gap: 3, space: em(20), ...heights(track, ink) },
      ],
      series,
      bands,
      hooks: { drawClear: [(plot) => shade(plot, shading)], drawAxes: [(plot) => track.bounds && between(plot, track.bounds)] },
    },
    plotted(track, frame.steps),
    parent,
  );
}

/** What uPlot draws of a track: the steps, the edges of each band, the lines. @param {Track} track */
export function plotted({ series }, steps) {
  const edges = series.filter(({ sigma }) => sigma).flatMap(({ values, sigma }) => [2, -2].map((by) => values.map((v, t) => v + by * sigma[t])));
  const lines = series.map(({ values }) => values);
  return [Float64Array.from({ length: steps }, (_, t) => t), ...edges, ...(lines.length ? lines : [new Array(steps).fill(null)])];
}

/** The y axis of a logarithmic chart has powers of ten alone, that of none names nothing. */
function heights({ log, note }, { grid, ticks }) {
  if (note) return { values: (_, splits) => splits.map(() => '') };
  if (!log) return {};
  const filter = (_, splits) => splits.map((v) => (Math.abs(Math.log10(v) - Math.round(Math.log10(v))) < 1e-9 ? v : null));
  return { filter, grid: { ...grid, filter }, ticks: { ...ticks, filter }, values: (_, splits) => splits.map((v) => (v ? String(Number(v.toPrecision(1))) : '')) };
}

/** Only the lowest track names the steps; the others have the same grid. (uPlot draws no axis after one not shown.) */
function stepAxis(ink, { withAxis, stepName }) {
  const axis = { ...ink, gap: 2, space: em(60), incrs: [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000] };
  if (!withAxis) return { ...axis, size: 0, ticks: { show: false }, values: (_, splits) => splits.map(() => '') };
  return { ...axis, size: GUTTER.axis - LABEL.labelSize, label: stepName, ...LABEL };
}

/** Fits what matters: the truth and the fused belief wholly, a modality that runs away only as far as most of it. */
function fitted(track, [from, to]) {
  let [low, high] = [Infinity, -Infinity];
  const take = (value) => {
    if (!Number.isFinite(value)) return;
    low = Math.min(low, value);
    high = Math.max(high, value);
  };
  const [first, last] = [Math.max(0, Math.floor(from)), Math.ceil(to)];
  for (const { name, values, sigma } of track.series) {
    const part = Array.from(values.slice(first, last + 1));
    if (name === 'truth' || name === 'fused') {
      part.forEach((v, t) => (sigma ? [v - 2 * sigma[first + t], v + 2 * sigma[first + t]] : [v]).forEach(take));
    } else {
      part.sort((a, b) => a - b);
      take(part[Math.floor(0.02 * (part.length - 1))]);
      take(part[Math.ceil(0.98 * (part.length - 1))]);
    }
  }
  if (track.log) return [Math.min(Math.max(low, LOWEST * track.bounds[0]), 0.5 * track.bounds[0]), Math.max(1.3 * high, 2 * track.bounds[1])];
  if (track.fromZero) low = 0;
  if (!(high > low)) [low, high] = Number.isFinite(low) ? [low - 1, low + 1] : [0, 1];
  const margin = 0.06 * (high - low);
  return [track.fromZero ? 0 : low - margin, high + margin];
}

/** Contact behind everything, as the paper draws it; edited steps; black pictures hatched along the top edge. @param {uPlot} plot @param {Shading} shading */
export function shade(plot, { contact, black, edit = [] }) {
  const { ctx, bbox } = plot;
  const across = ([first, last]) => {
    const left = Math.max(bbox.left, plot.valToPos(first - 0.5, 'x', true));
    return [left, Math.min(bbox.left + bbox.width, plot.valToPos(last + 0.5, 'x', true)) - left];
  };
  ctx.save();
  ctx.fillStyle = colour('contact-band');
  for (const [left, width] of contact.map(across)) if (width > 0) ctx.fillRect(left, bbox.top, width, bbox.height);
  ctx.fillStyle = translucent(colour('accent'), 0.12);
  for (const [left, width] of edit.map(across)) if (width > 0) ctx.fillRect(left, bbox.top, width, bbox.height);
  ctx.fillStyle = hatch(ctx);
  for (const [left, width] of black.map(across)) if (width > 0) ctx.fillRect(left, bbox.top, Math.max(width, 1), BLACK_STRIP * devicePixelRatio);
  ctx.restore();
}

/** Where values should lie. @param {uPlot} plot @param {[number, number]} bounds */
export function between(plot, bounds) {
  const { ctx, bbox } = plot;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  const [high, low] = bounds.map((v) => plot.valToPos(v, 'y', true)).sort((a, b) => a - b);
  ctx.globalAlpha = 0.1;
  ctx.fillStyle = colour('truth');
  ctx.fillRect(bbox.left, high, bbox.width, low - high);
  ctx.globalAlpha = 1;
  ctx.strokeStyle = colour('muted');
  ctx.lineWidth = devicePixelRatio;
  ctx.setLineDash([4 * devicePixelRatio, 3 * devicePixelRatio]);
  for (const y of [high, low]) {
    ctx.beginPath();
    ctx.moveTo(bbox.left, y);
    ctx.lineTo(bbox.left + bbox.width, y);
    ctx.stroke();
  }
  ctx.restore();
}

function hatch(ctx) {
  const tile = new OffscreenCanvas(8, 8);
  const pen = tile.getContext('2d');
  pen.strokeStyle = colour('black-band');
  pen.lineWidth = 1.5;
  pen.beginPath();
  for (const shift of [-8, 0, 8]) {
    pen.moveTo(shift, 8);
    pen.lineTo(shift + 8, 0);
  }
  pen.stroke();
  return ctx.createPattern(tile, 'repeat');
}
