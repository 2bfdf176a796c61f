/** The values of a chart of the timeline as uPlot draws them, and the range of its y axis. */

/** @import { Interval, Series, Track } from './chart.js' */
/** @import { StepAxis } from './step_axis.js' */

import { STEPS } from './step_axis.js';

const LOG_MARGIN = 0.1; // share of the lower bound at which a logarithmic axis starts at the latest

/**
 * Returns uPlot's data for a track: the positions of the steps, the edges of the bands and the lines.
 * @param {Track} track
 * @param {number} steps
 * @param {StepAxis} [axis]
 * @returns {uPlot.AlignedData}
 */
export function chartData({ series }, steps, axis = STEPS) {
  const edges = series.flatMap(({ values, sigma, aroundZero }) =>
    sigma
      ? [2, -2].map((factor) => values.map((v, t) => (aroundZero ? 0 : v) + factor * sigma[t]))
      : [],
  );
  const values = series.map((item) =>
    item.line === undefined ? item.values : withGaps(item.values),
  );
  return [
    Float64Array.from({ length: steps }, (_, t) => axis.position(t)),
    ...edges,
    ...(values.length ? values : [new Array(steps).fill(null)]),
  ];
}

/**
 * Returns values with null, which interrupts a line, in place of missing ones.
 * @param {Float32Array} values
 */
const withGaps = (values) =>
  values.every(Number.isFinite)
    ? values
    : Array.from(values, (value) => (Number.isFinite(value) ? value : null));

/**
 * Returns the steps whose neighbours have no value, such as those of a slow sensor, which a line does not show; null
 * without any. (A filter of points of uPlot.)
 * @param {uPlot} plot
 * @param {number} index of the series
 */
export function isolatedSteps({ data }, index) {
  const values = data[index];
  /** @type {number[]} */
  const steps = [];
  for (let t = 0; t < values.length; t++)
    if (isMissing(values[t - 1]) && !isMissing(values[t]) && isMissing(values[t + 1]))
      steps.push(t);
  return steps.length ? steps : null;
}

/** @param {number | null | undefined} value */
const isMissing = (value) => value === null || value === undefined;

/**
 * Returns the range of the y axis. It fits the visible truth and fused estimate, and most values of the modalities.
 * @param {Track} track
 * @param {Interval} window
 * @returns {Interval}
 */
export function valueRange(track, [from, to]) {
  if (track.limits) return track.limits;
  if (track.note) return [0, 1];
  const [first, last] = [Math.max(0, Math.floor(from)), Math.ceil(to)];
  const extremes = track.series
    .flatMap((series) => extremesOf(series, first, last))
    .filter(Number.isFinite);
  let [low, high] = [Math.min(...extremes), Math.max(...extremes)];
  if (track.log && track.bounds) {
    const [least, most] = track.bounds;
    return [
      Math.min(Math.max(low, LOG_MARGIN * least), 0.5 * least),
      Math.max(1.3 * high, 2 * most),
    ];
  }
  if (track.fromZero) low = 0;
  if (!(high > low)) [low, high] = Number.isFinite(low) ? [low - 1, low + 1] : [0, 1];
  const margin = 0.06 * (high - low);
  return [track.fromZero ? 0 : low - margin, high + margin];
}

/**
 * Returns values that the y axis must include.
 * @param {Series} series
 * @param {number} first
 * @param {number} last
 */
function extremesOf({ name, values, sigma, aroundZero, line }, first, last) {
  const visible = Array.from(values.subarray(first, last + 1));
  if (name === 'truth' || name === 'fused' || line !== undefined) {
    const bands = visible.flatMap((v, t) => {
      if (!sigma) return [v];
      const width = 2 * sigma[first + t];
      return aroundZero ? [v, -width, width] : [v - width, v + width];
    });
    const finite = bands.filter(Number.isFinite);
    return [
      finite.reduce((a, b) => Math.min(a, b), Infinity),
      finite.reduce((a, b) => Math.max(a, b), -Infinity),
    ];
  }
  visible.sort((a, b) => a - b);
  const end = visible.length - 1;
  return [visible[Math.floor(0.02 * end)], visible[Math.ceil(0.98 * end)]];
}
