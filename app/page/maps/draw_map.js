/** Draws one likelihood map on a canvas or as SVG. */

/** @import { ColourMap, LineStyle } from '../core/colours.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { Maps, Shade } from './map_values.js' */
/** @import { SvgContext } from './svg_context.js' */

import { COLOUR_TABLES, lineStyle, scaled } from '../core/colours.js';
import { context2d } from '../core/dom.js';
import { displayName, displayUnit, fixed } from '../core/units.js';
import { offsetOf } from './map_values.js';

/**
 * @typedef {CanvasRenderingContext2D | SvgContext} Context
 * @typedef {object} Layer of the displayed maps
 * @property {string} name
 * @property {number} index
 * @property {Maps} maps
 * @property {Trace} trace
 * @property {HTMLCanvasElement} cells
 * @property {Shade} shade
 * @property {ColourMap} colourMap
 * @property {number[][]} borders of regions, see `borders` in map_values.js
 *
 * @typedef {object} MapOptions
 * @property {string} axes `offset` from the true position, or `world`
 * @property {number} zoom
 * @property {boolean} cloud whether particles are drawn
 * @property {string} textColour
 * @property {boolean} withY whether the y axis has ticks
 * @property {boolean} named whether the axes have names
 * @property {number[] | null} hover offset of the crosshair
 *
 * @typedef {(position: number[]) => number[]} Projection from values of the axes to px
 */

/** px around the square of a map. */
export const MARGIN = {
  left: scaled(28),
  bottom: scaled(17),
  name: scaled(14), // for the name of an axis
  top: 1,
  right: scaled(5),
  gap: scaled(9),
};
const MIN_TICK_DISTANCE = scaled(26); // px
const LABEL_MARGIN = scaled(8); // px; labels nearer to the ends of their axis lie inside of them
/** @type {CanvasTextAlign[]} */
const ALIGN = ['left', 'center', 'right'];
/** @type {CanvasTextBaseline[]} */
const BASELINE = ['bottom', 'middle', 'top'];
const FONT = `${scaled(10)}px system-ui, sans-serif`;
const PARTICLE_RADIUS = scaled(22) / 10; // px, for the mean weight
const BORDER_OPACITIES = [0.95, 0.5]; // the smallest region first

/** @typedef {[colour: string, width: number]} Stroke */
/** @type {Stroke} */
const HALO = ['rgb(255 255 255 / 0.55)', 3];
/** @type {Stroke[]} */
const WHITE = [
  ['rgb(0 0 0 / 0.6)', 3],
  ['#fff', 1.25],
];
// px; the marks leave the middle open, so that a sharp peak stays visible, and none covers another one.
const MARK = { circle: 6, corner: 10, leg: 4, square: 9, arms: [13, 19], gap: 9 };
const ARROW = { shaft: 16, leg: 6 }; // px, towards an estimate off the map
/** Two standard deviations, and the standard deviation of a Gaussian from the area of its 95 % region. */
const [SIGMAS, AREA95] = [2, Math.PI * 5.991];
const DIRECTIONS = [
  [1, 0],
  [0, 1],
  [-1, 0],
  [0, -1],
];

/**
 * Colours the cells of a layer. Rows are reversed, so that y is up.
 * @param {HTMLCanvasElement} canvas
 * @param {Shade} shade
 * @param {number} size cells along a side
 * @param {ColourMap} colourMap
 */
export function paintCells(canvas, { values, low, high }, size, colourMap) {
  if (canvas.width !== size || canvas.height !== size) [canvas.width, canvas.height] = [size, size];
  const context = context2d(canvas);
  const image = context.createImageData(size, size);
  const pixels = new Uint32Array(image.data.buffer);
  const [table, scale] = [COLOUR_TABLES[colourMap], 255.99 / (high - low)];
  for (let row = 0; row < size; row++) {
    const target = (size - 1 - row) * size;
    for (let column = 0; column < size; column++) {
      const index = (values[row * size + column] - low) * scale;
      pixels[target + column] = table[index < 0 ? 0 : index > 255 ? 255 : index | 0];
    }
  }
  context.putImageData(image, 0, 0);
}

/**
 * Draws a map with its axes and marks. The upper left corner of its square is the origin.
 * @param {Context} context
 * @param {Layer} layer
 * @param {number} side px of the square
 * @param {MapOptions} options
 */
export function drawMap(context, layer, side, options) {
  const { cells } = layer;
  const visible = cells.width / options.zoom;
  const start = (cells.width - visible) / 2;
  context.drawImage(cells, start, start, visible, visible, 0, 0, side, side);
  drawAxes(context, layer.maps, side, options);
  context.save();
  context.beginPath();
  context.rect(0, 0, side, side);
  context.clip();
  layer.borders.forEach((segments, i) => drawBorder(context, segments, side, options.zoom, i));
  drawMarks(context, layer, side, options);
  context.restore();
}

/**
 * @param {Context} context
 * @param {Maps} maps
 * @param {number} side
 * @param {MapOptions} options
 */
function drawAxes(context, maps, side, { axes, zoom, textColour, withY, named }) {
  const x = mapAxis(maps, 0, side, axes, zoom);
  const y = withY ? mapAxis(maps, 1, side, axes, zoom) : null;
  drawXAxis(context, x, side, textColour, named);
  if (!y) return;
  context.beginPath();
  context.textAlign = 'right';
  for (const [text, place, end] of y.ticks) {
    context.textBaseline = BASELINE[end];
    context.moveTo(0, side - place);
    context.lineTo(-3, side - place);
    context.fillText(text, -5, side - place, MARGIN.left - 5); // narrows a long label: no minus sign is cut off
  }
  context.stroke();
  if (!named) return;
  context.textAlign = 'center';
  context.textBaseline = 'top';
  context.save();
  context.translate(1 - MARGIN.left - MARGIN.name, side / 2);
  context.rotate(-Math.PI / 2);
  context.fillText(y.label, 0, 0);
  context.restore();
}

/**
 * Returns the label and the ticks of an axis.
 * @param {Maps} maps
 * @param {number} i
 * @param {number} side px
 * @param {string} axes `offset` or `world`
 * @param {number} zoom
 */
export function mapAxis(maps, i, side, axes, zoom) {
  const [axis, world] = [maps.axes[i], axes === 'world'];
  const { unit, scale } = displayUnit(axis);
  const half = (scale * axis.half_width) / zoom;
  const name = displayName(axis.name);
  const label = world ? name : `Δ${name.length > 1 ? ' ' : ''}${name}`;
  return {
    label: unit ? `${label} (${unit})` : label,
    ticks: ticks(world ? scale * maps.centre[i] : 0, half, side),
  };
}

/**
 * @param {Context} context
 * @param {ReturnType<typeof mapAxis>} x
 * @param {number} side px
 * @param {string} textColour
 * @param {boolean} named whether it has its name
 */
export function drawXAxis(context, x, side, textColour, named) {
  context.font = FONT;
  context.fillStyle = context.strokeStyle = textColour;
  context.lineWidth = 1;
  context.textBaseline = 'top';
  context.beginPath();
  let free = -Infinity; // px from which there is room for a label
  for (const [text, place, end] of x.ticks) {
    context.textAlign = ALIGN[end];
    context.moveTo(place, side);
    context.lineTo(place, side + 3);
    const { width } = context.measureText(text);
    const start = place - (end * width) / 2;
    if (start < free) continue; // no room for this label
    free = start + width + scaled(3);
    context.fillText(text, place, side + scaled(5));
  }
  context.stroke();
  if (!named) return;
  context.textAlign = 'center';
  context.fillText(x.label, side / 2, side + scaled(18));
}

/**
 * Returns the ticks of an axis at multiples of 1, 2 or 5 times a power of ten: labels, places in px, and whether a tick
 * is at the start of the axis (0), at its end (2) or between them, which decides how its label is aligned.
 * @param {number} middle
 * @param {number} half extent
 * @param {number} side px
 */
function ticks(middle, half, side) {
  const smallest = (2 * half * MIN_TICK_DISTANCE) / side;
  const reach = half * (1 + 1e-6); // a tick at the end may lie beyond it after rounding
  const power = 10 ** Math.floor(Math.log10(smallest));
  const spacings = [1, 2, 5, 10].map((factor) => factor * power);
  const wide = spacings.find((value) => value >= smallest) ?? 10 * power;
  const spacing = wide > reach ? Math.max(...spacings.filter((value) => value <= reach)) : wide;
  const digits = Math.max(0, -Math.floor(Math.log10(spacing * 1.001)));
  /** @type {[text: string, place: number, end: 0 | 1 | 2][]} */
  const result = [];
  const [first, last] = [(middle - reach) / spacing, (middle + reach) / spacing];
  for (let count = Math.ceil(first); count <= last; count++) {
    const place = Math.round(((count * spacing - middle + half) / (2 * half)) * side) + 0.5;
    const end = place < LABEL_MARGIN ? 0 : place > side - LABEL_MARGIN ? 2 : 1;
    result.push([fixed(count * spacing, digits), place, end]);
  }
  return result;
}

/**
 * Draws the border of a region.
 * @param {Context} context
 * @param {number[]} segments see `borders` in map_values.js
 * @param {number} side px
 * @param {number} zoom
 * @param {number} region 0 for the smallest one
 */
export function drawBorder(context, segments, side, zoom, region) {
  /** @param {number} share */
  const position = (share) => ((share - 0.5) * zoom + 0.5) * side;
  /** @type {Stroke[]} */
  const strokes = [
    ['rgb(0 0 0 / 0.3)', 2.25],
    [`rgb(255 255 255 / ${BORDER_OPACITIES[region]})`, 1],
  ];
  strokeAll(context, strokes, () => {
    for (let i = 0; i < segments.length; i += 4) {
      context.moveTo(position(segments[i]), position(1 - segments[i + 1]));
      context.lineTo(position(segments[i + 2]), position(1 - segments[i + 3]));
    }
  });
}

/**
 * Draws particles, the ridge or ring, truth, estimates, the end effector and the expected ridge in contact, and the crosshair.
 * @param {Context} context
 * @param {Layer} layer
 * @param {number} side
 * @param {MapOptions} options
 */
function drawMarks(context, layer, side, { cloud, zoom, hover }) {
  const { maps, trace, name } = layer;
  const { centre, estimate, effector, expected, step, axes } = maps;
  /** @type {Projection} */
  const project = (position) => {
    const [x, y] = offsetOf(maps, position).map((d, i) => (d * zoom) / axes[i].half_width);
    return [((1 + x) / 2) * side, ((1 - y) / 2) * side];
  };
  const centrePx = project(centre);
  drawShape(context, layer, side, zoom, project);
  if (trace.contact[step] && expected !== null)
    drawExpectedRidge(context, centrePx, expected, side);
  if (trace.contact[step] && effector) drawEffector(context, project(effector));
  if (cloud) drawParticles(context, layer, project);
  if (maps.truth[axes[0].index] !== null) drawTruth(context, centrePx);
  const single = name !== 'fused' && trace.fuses;
  if (single) {
    const mean = axes.map(({ index, scale }) => (trace.mean(name, index)?.[step] ?? NaN) / scale);
    const place = project(mean);
    if (isOutside(place, side)) drawArrow(context, place, side, lineStyle(name));
    else drawModalityEstimate(context, place, lineStyle(name));
  }
  const place = project(axes.map(({ index }) => estimate[index]));
  if (isOutside(place, side)) drawArrow(context, place, side, lineStyle('fused'));
  else drawEstimate(context, place);
  if (hover) drawCrosshair(context, project(hover.map((d, i) => centre[i] + d)), side);
}

/**
 * Draws a dashed line through the true position.
 * @param {Context} context
 * @param {number[]} position px
 * @param {number} direction rad
 * @param {number} side px
 */
function drawExpectedRidge(context, [x, y], direction, side) {
  const [dx, dy] = [2 * side * Math.cos(direction), -2 * side * Math.sin(direction)];
  context.setLineDash([4, 4]);
  strokeAll(context, [['rgb(255 255 255 / 0.8)', 1]], () => {
    context.moveTo(x - dx, y - dy);
    context.lineTo(x + dx, y + dy);
  });
  context.setLineDash([]);
}

/**
 * Draws the ring fitted to the 50 % region, or the long axis of a ridge over two standard deviations to both sides.
 * @param {Context} context
 * @param {Layer} layer
 * @param {number} side px
 * @param {number} zoom
 * @param {Projection} project
 */
function drawShape(context, { maps, index }, side, zoom, project) {
  const { numbers, centre, axes } = maps;
  const scale = (side * zoom) / (2 * axes[0].half_width); // px per unit
  /** @param {(number | null)[]} offset */
  const place = (offset) => project(offset.map((d, i) => centre[i] + (d ?? NaN)));
  if (maps.shape[index] === 'ring') {
    const [x, y] = place(numbers.ring_centre[index]);
    context.setLineDash([6, 3]);
    strokeAll(context, WHITE, () =>
      context.arc(x, y, scale * (numbers.ring_radius[index] ?? NaN), 0, 2 * Math.PI),
    );
    context.setLineDash([]);
  }
  if (maps.shape[index] !== 'ridge') return;
  const [x, y] = place(numbers.mean[index]);
  const length =
    SIGMAS *
    scale *
    Math.sqrt((numbers.area95[index] * (numbers.elongation[index] ?? NaN)) / AREA95);
  const [cos, sin] = [Math.cos(numbers.axis[index] ?? NaN), -Math.sin(numbers.axis[index] ?? NaN)];
  strokeAll(context, WHITE, () => {
    for (const end of [-1, 1]) {
      const [endX, endY] = [x + end * length * cos, y + end * length * sin];
      context.moveTo(
        x + end * Math.min(MARK.gap, length) * cos,
        y + end * Math.min(MARK.gap, length) * sin,
      );
      context.lineTo(endX, endY);
      context.moveTo(endX - 4 * sin, endY + 4 * cos);
      context.lineTo(endX + 4 * sin, endY - 4 * cos);
    }
  });
}

/**
 * Draws the corners of a square.
 * @param {Context} context
 * @param {number[]} position px
 */
function drawEffector(context, [x, y]) {
  const { square, leg } = MARK;
  strokeAll(context, WHITE, () => {
    for (const [dx, dy] of [
      [1, 1],
      [1, -1],
      [-1, -1],
      [-1, 1],
    ]) {
      context.moveTo(x + (square - leg) * dx, y + square * dy);
      context.lineTo(x + square * dx, y + square * dy);
      context.lineTo(x + square * dx, y + (square - leg) * dy);
    }
  });
}

/**
 * Draws the arms of a cross.
 * @param {Context} context
 * @param {number[]} position px
 */
function drawTruth(context, [x, y]) {
  const [from, to] = MARK.arms;
  strokeAll(context, WHITE, () => {
    for (const [dx, dy] of DIRECTIONS) {
      context.moveTo(x + from * dx, y + from * dy);
      context.lineTo(x + to * dx, y + to * dy);
    }
  });
}

/**
 * @param {Context} context
 * @param {number[]} position px
 * @param {LineStyle} style
 */
function drawModalityEstimate(context, [x, y], { stroke }) {
  strokeAll(context, [HALO, [stroke, 1.5]], () => context.arc(x, y, MARK.circle, 0, 2 * Math.PI));
}

/**
 * Draws the corners of a diamond.
 * @param {Context} context
 * @param {number[]} position px
 */
function drawEstimate(context, [x, y]) {
  const { corner, leg } = MARK;
  strokeAll(context, [HALO, [lineStyle('fused').stroke, 2]], () => {
    for (const [dx, dy] of DIRECTIONS) {
      const [tipX, tipY] = [x + corner * dx, y + corner * dy];
      context.moveTo(tipX - leg * (dx - dy), tipY - leg * (dy - dx));
      context.lineTo(tipX, tipY);
      context.lineTo(tipX - leg * (dx + dy), tipY - leg * (dy + dx));
    }
  });
}

/**
 * @param {number[]} position px
 * @param {number} side px
 */
const isOutside = (position, side) => position.some((value) => value < 0 || value > side);

/**
 * Draws an arrow at the border of the map towards an estimate outside of it.
 * @param {Context} context
 * @param {number[]} position px
 * @param {number} side px
 * @param {LineStyle} style
 */
function drawArrow(context, [x, y], side, { stroke }) {
  const half = side / 2;
  const [right, down] = [x - half, y - half];
  const reach = (half - 2) / Math.max(Math.abs(right), Math.abs(down));
  const [tipX, tipY] = [half + reach * right, half + reach * down];
  const length = Math.hypot(right, down);
  const [dx, dy] = [right / length, down / length];
  const { shaft, leg } = ARROW;
  strokeAll(context, [HALO, [stroke, 2]], () => {
    context.moveTo(tipX - shaft * dx, tipY - shaft * dy);
    context.lineTo(tipX, tipY);
    for (const turn of [-1, 1]) {
      context.moveTo(tipX, tipY);
      context.lineTo(tipX - leg * (dx - turn * dy), tipY - leg * (dy + turn * dx));
    }
  });
}

/**
 * Draws lines to the crosshair that end before its centre.
 * @param {Context} context
 * @param {number[]} position px
 * @param {number} side
 */
function drawCrosshair(context, [x, y], side) {
  const { gap } = MARK;
  /** @type {Stroke[]} */
  const strokes = [
    ['rgb(0 0 0 / 0.35)', 2.5],
    ['rgb(255 255 255 / 0.8)', 1],
  ];
  strokeAll(context, strokes, () => {
    for (const [from, to] of [
      [0, -gap],
      [side, gap],
    ]) {
      context.moveTo(from, y);
      context.lineTo(x + to, y);
      context.moveTo(x, from);
      context.lineTo(x, y + to);
    }
  });
}

/**
 * Draws the particles with areas proportional to their weights in the layer.
 * @param {Context} context
 * @param {Layer} layer
 * @param {Projection} project
 */
function drawParticles(context, { maps, index }, project) {
  const weights = maps.weights[index];
  context.lineWidth = 0.75;
  weights.forEach((weight, i) => {
    const share = weight * weights.length; // 1 for the mean weight
    const [x, y] = project([maps.positions[2 * i], maps.positions[2 * i + 1]]);
    const alpha = Math.min(0.12 + 0.5 * share, 0.75).toFixed(2);
    const radius = Math.min(Math.max(PARTICLE_RADIUS * Math.sqrt(share), 0.8), 9);
    context.fillStyle = `rgb(255 255 255 / ${alpha})`;
    context.strokeStyle = `rgb(0 0 0 / ${alpha})`;
    context.beginPath();
    context.arc(x, y, radius, 0, 2 * Math.PI);
    context.fill();
    context.stroke();
  });
}

/**
 * Strokes the same path with several styles.
 * @param {Context} context
 * @param {Stroke[]} strokes
 * @param {() => void} path
 */
function strokeAll(context, strokes, path) {
  for (const [colour, width] of strokes) {
    [context.strokeStyle, context.lineWidth] = [colour, width];
    context.beginPath();
    path();
    context.stroke();
  }
}
