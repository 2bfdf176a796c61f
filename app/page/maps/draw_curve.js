/** Draws the map over one component as a curve, on a canvas or as SVG. */

/** @import { Context, Layer, MapOptions } from './draw_map.js' */

import { lineStyle } from '../core/colours.js';
import { drawXAxis, mapAxis } from './draw_map.js';
import { offsetOf, rangeDigits, rangeLabels } from './map_values.js';

const TOP = 0.06; // of the height, above the curve
const LABEL_OFFSET = 5; // px from the axis

/**
 * Draws a curve with its axis, and lines at the truth, the estimates and the crosshair. The upper left corner of its
 * square is the origin.
 * @param {Context} context
 * @param {Layer} layer
 * @param {number} side px of the square
 * @param {MapOptions} options
 */
export function drawCurve(context, layer, side, options) {
  const { maps, trace, name, shade } = layer;
  const { axes, zoom, textColour, withY, named, hover } = options;
  drawXAxis(context, mapAxis(maps, 0, side, axes, zoom), side, textColour, named);
  if (withY) drawRange(context, layer, side);
  const [axis] = maps.axes;
  /** @param {number} offset */
  const x = (offset) => ((1 + (offset * zoom) / axis.half_width) / 2) * side;
  /** @param {number} value */
  const y = (value) =>
    side * (1 - ((1 - TOP) * (value - shade.low)) / (shade.high - shade.low || 1));
  context.save();
  context.beginPath();
  context.rect(0, 0, side, side);
  context.clip();
  /** @param {number} offset @param {string} colour @param {number[]} dash */
  const line = (offset, colour, dash) => {
    context.setLineDash(dash);
    [context.strokeStyle, context.lineWidth] = [colour, 1.5];
    context.beginPath();
    context.moveTo(x(offset), 0);
    context.lineTo(x(offset), side);
    context.stroke();
    context.setLineDash([]);
  };
  if (maps.truth[axis.index] !== null) line(0, lineStyle('truth').stroke, []);
  if (name !== 'fused' && trace.fuses) {
    const mean = (trace.mean(name, axis.index)?.[maps.step] ?? NaN) / axis.scale;
    if (Number.isFinite(mean)) line(offsetOf(maps, [mean])[0], lineStyle(name).stroke, [2, 3]);
  }
  line(offsetOf(maps, [maps.estimate[axis.index]])[0], lineStyle('fused').stroke, [5, 3]);
  const source = trace.fuses ? name : 'fused'; // as the dot in the title
  [context.strokeStyle, context.lineWidth] = [lineStyle(source).stroke, 2];
  context.beginPath();
  shade.values.forEach((value, i) => {
    const place = x((((i + 0.5) / maps.size) * 2 - 1) * axis.half_width);
    if (i) context.lineTo(place, y(value));
    else context.moveTo(place, y(value));
  });
  context.stroke();
  if (hover) line(hover[0], textColour, []);
  context.restore();
  [context.strokeStyle, context.lineWidth] = [textColour, 1];
  context.beginPath();
  context.rect(0.5, 0.5, side - 1, side - 1);
  context.stroke();
}

/**
 * Labels the ends of the vertical axis.
 * @param {Context} context
 * @param {Layer} layer
 * @param {number} side px
 */
function drawRange(context, { shade }, side) {
  const [low, high] = rangeLabels(shade, rangeDigits(shade));
  context.textAlign = 'right';
  context.textBaseline = 'bottom';
  context.fillText(low, -LABEL_OFFSET, side);
  context.textBaseline = 'top';
  context.fillText(high, -LABEL_OFFSET, TOP * side);
}
