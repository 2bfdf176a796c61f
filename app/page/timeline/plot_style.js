/** Style of plots: axes and ticks, and drawing within a plot. */

import { colour, scaled } from '../core/colours.js';
import { typeset } from '../core/units.js';

/** @typedef {{stroke: string, grid: uPlot.Axis.Grid, ticks: uPlot.Axis.Ticks, font: string}} AxisStyle */

const FONT = `${scaled(10)}px system-ui, sans-serif`;
/** Options of all charts, which have neither a cursor nor a legend nor a selection of their own. */
export const PLAIN = {
  cursor: { show: false },
  legend: { show: false },
  select: { show: false, left: 0, top: 0, width: 0, height: 0 },
};
/** Style of axis labels. */
export const LABEL = { labelSize: scaled(14), labelGap: 0, labelFont: FONT };
/** Distances of the ticks of whole numbers, such as steps. */
export const WHOLE_STEPS = Array.from({ length: 8 }, (_, power) =>
  [1, 2, 5].map((n) => n * 10 ** power),
).flat();

/** @returns {AxisStyle} */
export const plainAxis = () => ({
  stroke: colour('muted'),
  grid: { stroke: colour('grid'), width: 1 },
  ticks: { stroke: colour('grid'), size: 4, width: 1 },
  font: FONT,
});

/** Style of an axis of numbers. */
export const axisStyle = () => ({ ...plainAxis(), values: tickLabels });

/**
 * Labels of ticks, with true minus signs.
 * @param {uPlot} _
 * @param {number[]} splits
 */
export const tickLabels = (_, splits) =>
  splits.map((value) => (value === null ? '' : typeset(String(Number(value.toPrecision(6))))));

/**
 * Saves the drawing state, and restricts drawing to the plot until it is restored.
 * @param {uPlot} plot
 */
export function clipToPlot({ ctx, bbox }) {
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
}
