/** A chart of the timeline: a uPlot chart without its own cursor and legend, with shaded intervals. */

/** @import { AxisStyle } from './plot_style.js' */
/** @import { StepAxis } from './step_axis.js' */

import { context2d } from '../core/dom.js';
import { channelStyle, colour, lineStyle, scaled, translucent } from '../core/colours.js';
import { chartData, isolatedSteps, valueRange } from './chart_data.js';
import { PLAIN, WHOLE_STEPS, clipToPlot, plainAxis, tickLabels } from './plot_style.js';
import { drawStack } from './stacked_weights.js';
import { STEPS } from './step_axis.js';

/**
 * @typedef {object} Series
 * @property {string} name truth, fused or a modality
 * @property {Float32Array} values
 * @property {Float32Array} [sigma] draws a band of ±2 sigma
 * @property {boolean} [aroundZero] whether the band is around zero instead of the values
 * @property {number} [line] number of a channel, for its colour; its missing values are gaps
 * @property {boolean} [comparison] whether it belongs to the comparison run
 * @property {boolean} [stacked] whether it is an area on those before it
 *
 * @typedef {object} Track
 * @property {string} [key] of the chart in the timeline
 * @property {string} title
 * @property {string} unit
 * @property {string} [help]
 * @property {Series[]} series
 * @property {[number, number]} [limits] of the y axis; by default it fits the visible values
 * @property {boolean} [fromZero] whether the y axis starts at 0
 * @property {boolean} [log] whether the y axis is logarithmic; needs `bounds`
 * @property {[number, number]} [bounds] interval that is expected to contain the values
 * @property {number} [digits] of the values in the legend; three significant ones by default
 * @property {boolean} [ofModalities] whether the series are quantities of the modalities rather than estimates
 * @property {string} [note] text in place of a chart
 *
 * @typedef {[first: number, last: number]} Interval of steps
 * @typedef {{contact: Interval[], blackout: Interval[], interventions: Interval[], failure?: Interval[], repair?: Interval[], faulty?: Interval[], label?: string, faultLabel?: string}} Shading faulty: with injected faults; label: of the shaded steps
 *
 * @typedef {object} Frame
 * @property {number} width px
 * @property {number} height px
 * @property {() => Interval} window visible steps
 * @property {number} steps
 * @property {StepAxis} axis
 * @property {boolean} withAxis whether the step axis has numbers
 */

/** px beside and below the plot; a label of the step axis needs more. */
export const GUTTER = { left: scaled(46), right: scaled(12), axis: scaled(19) };
const TICK_HALF = scaled(6); // px above and below the plot, for half of a tick's label
const BLACKOUT_HEIGHT = scaled(8); // px
const STRIP_HEIGHT = scaled(12); // px, of the labelled strips for contact and blackout over areas
const AREA_GRID_OPACITY = 0.3; // of the grid over areas
const COMPARISON_OPACITY = 0.65;
const COMPARISON_WIDTH = 1.25; // px
const POINT = scaled(4); // px, of a single value between gaps
const LINE_HEIGHT = 4; // px, of a failure and its repair
const INTEGER_TOLERANCE = 1e-9;

/**
 * Returns the style of a line. A line of the comparison run has the colour and dashes of its quantity, thinner and lighter.
 * @param {Pick<Series, 'name' | 'comparison' | 'line'>} series
 */
export function seriesStyle({ name, comparison = false, line }) {
  const style = line === undefined ? lineStyle(name) : channelStyle(line);
  if (!comparison) return style;
  const stroke = translucent(style.stroke, COMPARISON_OPACITY);
  return { ...style, stroke, width: COMPARISON_WIDTH };
}

/**
 * @param {HTMLElement} parent
 * @param {Track} track
 * @param {Shading} shading
 * @param {Frame} frame
 * @returns {uPlot}
 */
export function chart(parent, track, shading, frame) {
  const hasAreas = track.series.some(({ stacked }) => stacked);
  const grid = hasAreas ? translucent(colour('surface'), AREA_GRID_OPACITY) : colour('grid');
  const shade = (/** @type {uPlot} */ plot) => shadeIntervals(plot, shading, hasAreas, axis);
  const style = { ...plainAxis(), grid: { stroke: grid, width: 1, show: !track.note } };
  const { bounds } = track;
  const { axis } = frame;
  /** @returns {Interval} */
  const range = () => {
    const [from, to] = frame.window();
    return [axis.position(from), axis.position(to)];
  };
  return new uPlot(
    {
      width: frame.width,
      height: frame.height,
      padding: [TICK_HALF, GUTTER.right, frame.withAxis ? 0 : TICK_HALF, 0],
      ...PLAIN,
      scales: {
        x: { time: false, range },
        y: { distr: track.log ? 3 : 1, range: () => valueRange(track, frame.window()) },
      },
      axes: [
        stepAxis(style, frame),
        { ...style, size: GUTTER.left, gap: 3, space: scaled(14), ...valueAxis(track, style) },
      ],
      ...lines(track),
      hooks: {
        drawClear: [hasAreas ? (plot) => drawStack(plot, track, axis) : shade],
        drawAxes: [
          (plot) => void (bounds && shadeBounds(plot, bounds)),
          ...(hasAreas ? [shade] : []), // above the grid, which would cross the labels
        ],
      },
    },
    chartData(track, frame.steps, axis),
    parent,
  );
}

/**
 * Returns uPlot's series and bands for a track, in the order of `chartData`.
 * @param {Track} track
 * @returns {{series: uPlot.Series[], bands: uPlot.Band[]}}
 */
function lines(track) {
  /** @type {uPlot.Series[]} */
  const series = [{}];
  /** @type {uPlot.Band[]} */
  const bands = [];
  for (const { name, sigma, line } of track.series) {
    if (!sigma) continue;
    const edge = { points: { show: false }, width: 0, stroke: 'transparent' };
    series.push({ ...edge }, { ...edge });
    const fill = translucent(seriesStyle({ name, line }).stroke, name === 'fused' ? 0.2 : 0.08);
    bands.push({ series: [series.length - 2, series.length - 1], fill });
  }
  for (const item of track.series) {
    const paths = item.stacked ? { paths: () => null } : {}; // drawStack draws it
    const style = seriesStyle(item);
    /** @type {uPlot.Series.Points} */
    const points =
      item.line === undefined
        ? { show: false }
        : {
            show: false,
            filter: isolatedSteps,
            size: POINT,
            stroke: style.stroke,
            fill: style.stroke,
          };
    series.push({ ...style, ...paths, points });
  }
  if (!track.series.length) series.push({}); // uPlot draws an axis only for a line
  return { series, bands };
}

/**
 * Returns the options of the y axis: only powers of ten on a logarithmic one, no labels without a chart.
 * @param {Track} track
 * @param {AxisStyle} style
 * @returns {uPlot.Axis}
 */
function valueAxis({ log, note }, { grid, ticks }) {
  if (note) return { values: (_, splits) => splits.map(() => '') };
  if (!log) return { values: tickLabels };
  /** @type {uPlot.Axis.Filter} */
  const filter = (_, splits) =>
    splits.map((v) => {
      const exponent = Math.log10(v);
      return Math.abs(exponent - Math.round(exponent)) < INTEGER_TOLERANCE ? v : null;
    });
  return {
    filter,
    grid: { ...grid, filter },
    ticks: { ...ticks, filter },
    values: (_, splits) => splits.map((v) => (v ? String(Number(v.toPrecision(1))) : '')),
  };
}

/**
 * Returns the step axis. Only the lowest chart has its numbers; the others have the same grid. (uPlot draws no axis after a hidden one.)
 * @param {AxisStyle} style
 * @param {Frame} frame
 * @returns {uPlot.Axis}
 */
function stepAxis(style, { withAxis, axis: { inSeconds } }) {
  const increments = inSeconds ? {} : { incrs: WHOLE_STEPS };
  const axis = { ...style, gap: 2, space: scaled(60), ...increments };
  if (!withAxis)
    return {
      ...axis,
      size: 0,
      ticks: { show: false },
      values: (_, splits) => splits.map(() => ''),
    };
  return { ...axis, size: GUTTER.axis };
}

/**
 * Shades contact and interventions, hatches blackouts along the top edge, marks injected faults and underlines a
 * failure and its repair.
 * @param {uPlot} plot
 * @param {Shading} shading
 * @param {boolean} [hasAreas] whether areas fill the chart, whose colours a band for contact would change: it is a strip
 * @param {StepAxis} [axis]
 */
export function shadeIntervals(plot, shading, hasAreas = false, axis = STEPS) {
  const { contact, blackout, interventions, failure = [], repair = [], faulty = [] } = shading;
  const { ctx, bbox } = plot;
  /** @param {Interval[]} intervals @param {string | CanvasPattern | null} fill @param {number} [height] @param {number} [top] */
  const shade = (intervals, fill, height = bbox.height, top = bbox.top) => {
    ctx.fillStyle = fill ?? 'transparent';
    for (const interval of intervals) {
      const [left, right] = visiblePart(plot, axis, interval);
      if (right > left) ctx.fillRect(left, top, Math.max(right - left, 1), height);
    }
  };
  const line = LINE_HEIGHT * devicePixelRatio;
  ctx.save();
  shade(interventions, translucent(colour('accent'), 0.12));
  if (hasAreas) {
    const strip = STRIP_HEIGHT * devicePixelRatio;
    const bottom = bbox.top + bbox.height - strip;
    shade(contact, colour('contact'), strip, bottom);
    labelIntervals(plot, axis, contact, [shading.label ?? ''], bottom, colour('surface'), null);
    const below = bbox.top + (faulty.length ? line : 0);
    shade(blackout, hatching(ctx), strip, below);
    labelIntervals(plot, axis, blackout, ['no image'], below, colour('ink'), colour('surface'));
    shade(faulty, colour('bad'), line);
    const top = below + (blackout.length ? strip : 0);
    const { faultLabel = '' } = shading;
    labelIntervals(
      plot,
      axis,
      faulty,
      [faultLabel, 'injected'],
      top,
      colour('bad'),
      colour('surface'),
    );
  } else {
    shade(contact, colour('contact-band'));
    shade(blackout, hatching(ctx), BLACKOUT_HEIGHT * devicePixelRatio);
    shade(faulty, colour('bad'), line / 2);
  }
  shade(failure, colour('bad'), line, bbox.top + bbox.height - line);
  shade(repair, colour('accent'), line, bbox.top + bbox.height - 2 * line);
  ctx.restore();
}

/**
 * Returns the visible part of an interval in px.
 * @param {uPlot} plot
 * @param {StepAxis} axis
 * @param {Interval} interval
 */
function visiblePart({ bbox, valToPos }, axis, [first, last]) {
  const [start, end] = [first - 0.5, last + 0.5].map((step) =>
    valToPos(axis.position(step), 'x', true),
  );
  return [Math.max(bbox.left, start), Math.min(bbox.left + bbox.width, end)];
}

/**
 * Writes the first text that has room into each interval.
 * @param {uPlot} plot
 * @param {StepAxis} axis
 * @param {Interval[]} intervals
 * @param {string[]} texts the longest one first
 * @param {number} top of the strip
 * @param {string} ink
 * @param {string | null} background
 */
function labelIntervals(plot, axis, intervals, texts, top, ink, background) {
  const { ctx } = plot;
  const height = STRIP_HEIGHT * devicePixelRatio;
  ctx.font = `${scaled(9.5) * devicePixelRatio}px system-ui, sans-serif`;
  [ctx.textAlign, ctx.textBaseline] = ['center', 'middle'];
  const labels = texts.map((text) => ({
    text,
    width: ctx.measureText(text).width + 6 * devicePixelRatio,
  }));
  for (const interval of intervals) {
    const [left, right] = visiblePart(plot, axis, interval);
    const label = labels.find(({ width }) => width <= right - left);
    if (!label) continue;
    const { text, width } = label;
    const centre = (left + right) / 2;
    ctx.fillStyle = background ?? 'transparent';
    ctx.fillRect(centre - width / 2, top, width, height);
    ctx.fillStyle = ink;
    ctx.fillText(text, centre, top + height / 2);
  }
}

/**
 * Shades the interval that is expected to contain the values.
 * @param {uPlot} plot
 * @param {[number, number]} bounds
 */
export function shadeBounds(plot, bounds) {
  const { ctx, bbox } = plot;
  clipToPlot(plot);
  const [top, bottom] = bounds.map((v) => plot.valToPos(v, 'y', true)).sort((a, b) => a - b);
  ctx.globalAlpha = 0.1;
  ctx.fillStyle = colour('truth');
  ctx.fillRect(bbox.left, top, bbox.width, bottom - top);
  ctx.globalAlpha = 1;
  ctx.strokeStyle = colour('muted');
  ctx.lineWidth = devicePixelRatio;
  ctx.setLineDash([4 * devicePixelRatio, 3 * devicePixelRatio]);
  for (const y of [top, bottom]) {
    ctx.beginPath();
    ctx.moveTo(bbox.left, y);
    ctx.lineTo(bbox.left + bbox.width, y);
    ctx.stroke();
  }
  ctx.restore();
}

/** @param {CanvasRenderingContext2D} context */
export function hatching(context) {
  const tile = document.createElement('canvas');
  [tile.width, tile.height] = [8, 8];
  const tileContext = context2d(tile);
  tileContext.strokeStyle = colour('blackout-band');
  tileContext.lineWidth = 1.5;
  tileContext.beginPath();
  for (const shift of [-8, 0, 8]) {
    tileContext.moveTo(shift, 8);
    tileContext.lineTo(shift + 8, 0);
  }
  tileContext.stroke();
  return context.createPattern(tile, 'repeat');
}
