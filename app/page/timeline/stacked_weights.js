/** Stacked areas: fusion weights, which sum to one, with a column for each step. */

/** @import { Series, Track } from './chart.js' */
/** @import { StepAxis } from './step_axis.js' */

import { colour, cssVariable, lineStyle, translucent } from '../core/colours.js';
import { clipToPlot } from './plot_style.js';

const SUM_TOLERANCE = 1e-3; // of weights in single precision, and of the normalisation of networks
/** Opacity of the areas, from below: neighbours differ without colour too. */
const OPACITIES = [0.75, 0.45];

/**
 * Returns whether series are shares of one at every step that has values.
 * @param {Series[]} series
 */
export function areShares(series) {
  if (series.length < 2) return false;
  for (let t = 0; t < series[0].values.length; t++) {
    const values = series.map((item) => item.values[t]);
    if (!values.some(Number.isFinite)) continue;
    const sum = values.reduce((a, b) => a + b, 0);
    if (!(Math.abs(sum - 1) < SUM_TOLERANCE) || values.some((v) => v < -SUM_TOLERANCE))
      return false;
  }
  return true;
}

/**
 * Returns the upper edge of each series stacked on those before it.
 * @param {Series[]} series
 */
export function upperEdges(series) {
  /** @type {Float32Array[]} */
  const edges = [];
  for (const { values } of series) {
    const below = edges.at(-1);
    edges.push(values.map((value, t) => value + (below ? below[t] : 0)));
  }
  return edges;
}

/** @param {number} index of the area from below */
export const opacity = (index) => OPACITIES[index % OPACITIES.length];

/**
 * Draws the stacked series of a track: areas for the run, light edges for the comparison run.
 * @param {uPlot} plot
 * @param {Track} track
 * @param {StepAxis} axis
 */
export function drawStack(plot, track, axis) {
  const { ctx } = plot;
  const stacked = track.series.filter((item) => item.stacked);
  if (!stacked.length) return;
  clipToPlot(plot);
  const run = stacked.filter(({ comparison }) => !comparison);
  const edges = upperEdges(run);
  run.forEach(({ name }, i) => {
    ctx.fillStyle = translucent(lineStyle(name).stroke, opacity(i));
    ctx.fill(columns(plot, axis, edges[i], edges[i - 1] ?? null));
  });
  ctx.strokeStyle = colour('ink');
  ctx.lineWidth = devicePixelRatio;
  for (const edge of edges.slice(0, -1)) ctx.stroke(steps(plot, axis, edge));
  ctx.strokeStyle = colour('surface');
  ctx.lineWidth = 1.5 * devicePixelRatio;
  const others = upperEdges(stacked.filter(({ comparison }) => comparison));
  for (const edge of others.slice(0, -1)) ctx.stroke(steps(plot, axis, edge));
  ctx.restore();
}

/**
 * First and last step whose columns are visible.
 * @param {uPlot} plot
 * @param {StepAxis} axis
 * @param {ArrayLike<number>} values
 */
function visibleSteps({ scales }, axis, values) {
  const { min = 0, max = 0 } = scales.x;
  const [from, to] = [axis.step(min), axis.step(max)];
  return [Math.max(0, Math.floor(from)), Math.min(values.length - 1, Math.ceil(to))];
}

/**
 * The area between two edges as one rectangle for each step.
 * @param {uPlot} plot
 * @param {StepAxis} axis
 * @param {ArrayLike<number>} top
 * @param {ArrayLike<number> | null} bottom null for zero
 */
function columns(plot, axis, top, bottom) {
  const path = new Path2D();
  const [first, last] = visibleSteps(plot, axis, top);
  const y = (/** @type {number} */ value) => plot.valToPos(value, 'y', true);
  let left = Math.round(plot.valToPos(axis.position(first - 0.5), 'x', true));
  for (let t = first; t <= last; t++) {
    const right = Math.round(plot.valToPos(axis.position(t + 0.5), 'x', true));
    const base = bottom ? bottom[t] : 0;
    // Whole pixels: otherwise a gap shows between neighbours.
    if (Number.isFinite(top[t])) path.rect(left, y(top[t]), right - left, y(base) - y(top[t]));
    left = right;
  }
  return path;
}

/**
 * An edge as a line with a tread for each step.
 * @param {uPlot} plot
 * @param {StepAxis} axis
 * @param {ArrayLike<number>} edge
 */
function steps(plot, axis, edge) {
  const path = new Path2D();
  const [first, last] = visibleSteps(plot, axis, edge);
  let drawing = false;
  for (let t = first; t <= last; t++) {
    if (Number.isFinite(edge[t])) {
      const y = plot.valToPos(edge[t], 'y', true);
      const [left, right] = [t - 0.5, t + 0.5].map((step) =>
        plot.valToPos(axis.position(step), 'x', true),
      );
      if (drawing) path.lineTo(left, y);
      else path.moveTo(left, y);
      path.lineTo(right, y);
    }
    drawing = Number.isFinite(edge[t]);
  }
  return path;
}

/**
 * Creates a sample of a stacked area, for legends.
 * @param {string} name of the series
 * @param {number} index of the area from below
 */
export function areaSample(name, index) {
  const sample = document.createElement('i');
  sample.className = 'swatch area';
  sample.style.background = translucent(`var(${cssVariable(name)})`, opacity(index));
  return sample;
}
