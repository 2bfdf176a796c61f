/** One likelihood map on a pen: the context of a canvas, or an `SvgPen` with the same strokes. */

import { TABLES, em, line } from '../core/palette.js';
import { fixed } from '../core/units.js';

export const MARGIN = { left: em(38), bottom: em(30), top: 1, right: em(5), gap: em(9) }; // px around a map's square
const SPACINGS = [1, 2, 5, 10, 20, 50, 100]; // cm between ticks
const APART = em(26); // px between them at least
const HALO = ['rgb(255 255 255 / 0.55)', 3.5];
const FONT = `${em(10)}px system-ui, sans-serif`;
const PARTICLE = em(22) / 10; // px radius of one with the mean weight
const STRENGTHS = [0.95, 0.5]; // of the regions' borders, the smallest first

/**
 * @typedef {object} Drawn one layer, ready to be drawn
 * @property {string} name @property {number} layer @property {import('./map_values.js').Maps} maps @property {import('../data/trace.js').Trace} trace
 * @property {HTMLCanvasElement} cells @property {number[][]} borders of regions, see `mapvalues.borders`
 * @typedef {{axes: 'offset' | 'world', zoom: number, cloud: boolean, text: string, withY: boolean, hover: number[] | null}} Look text: its colour
 */

/** Colours of the cells, turned over so that y is up. @param {import('./map_values.js').Shade} shade */
export function paint(canvas, { values, low, high }, size, colours) {
  if (canvas.width !== size || canvas.height !== size) [canvas.width, canvas.height] = [size, size];
  const pen = canvas.getContext('2d');
  const image = pen.createImageData(size, size);
  const pixels = new Uint32Array(image.data.buffer);
  const [table, steps] = [TABLES[colours], 255.99 / (high - low)];
  for (let row = 0; row < size; row++) {
    const to = (size - 1 - row) * size;
    for (let column = 0; column < size; column++) {
      const place = (values[row * size + column] - low) * steps;
      pixels[to + column] = table[place < 0 ? 0 : place > 255 ? 255 : place | 0];
    }
  }
  pen.putImageData(image, 0, 0);
}

/** A map with its axes and marks; its square's upper left corner is the pen's origin. @param {Drawn} drawn @param {Look} look */
export function drawMap(pen, drawn, side, look) {
  const { cells } = drawn;
  const cut = cells.width / look.zoom; // of the cells, in the middle
  pen.drawImage(cells, (cells.width - cut) / 2, (cells.width - cut) / 2, cut, cut, 0, 0, side, side);
  drawAxes(pen, drawn, side, look);
  pen.save();
  pen.beginPath();
  pen.rect(0, 0, side, side);
  pen.clip();
  drawn.borders.forEach((segments, i) => drawBorder(pen, segments, side, look.zoom, STRENGTHS[i]));
  drawMarks(pen, drawn, side, look);
  pen.restore();
}

function drawAxes(pen, { maps }, side, { axes, zoom, text, withY }) {
  const half = (100 * maps.half_width) / zoom;
  const spacing = SPACINGS.find((cm) => (cm / (2 * half)) * side > APART) ?? 2 * half;
  const middle = axes === 'world' ? maps.centre.map((m) => 100 * m) : [0, 0];
  pen.font = FONT;
  pen.fillStyle = pen.strokeStyle = text;
  pen.lineWidth = 1;
  pen.textBaseline = 'top';
  pen.textAlign = 'center';
  pen.beginPath();
  for (const [cm, at] of ticks(middle[0], half, spacing, side)) {
    pen.moveTo(at, side);
    pen.lineTo(at, side + 3);
    pen.fillText(fixed(cm, 0), at, side + em(5));
  }
  if (withY) {
    pen.textAlign = 'right';
    pen.textBaseline = 'middle';
    for (const [cm, at] of ticks(middle[1], half, spacing, side)) {
      pen.moveTo(0, side - at);
      pen.lineTo(-3, side - at);
      pen.fillText(fixed(cm, 0), -5, side - at);
    }
  }
  pen.stroke();
  pen.textAlign = 'center';
  pen.textBaseline = 'top';
  const called = axes === 'world' ? ['x (cm)', 'y (cm)'] : ['Δx (cm)', 'Δy (cm)'];
  pen.fillText(called[0], side / 2, side + em(18));
  if (!withY) return;
  pen.save();
  pen.translate(-MARGIN.left + 1, side / 2);
  pen.rotate(-Math.PI / 2);
  pen.fillText(called[1], 0, 0);
  pen.restore();
}

/** Round values along an axis and where they are, px. @returns {[number, number][]} */
function ticks(middle, half, spacing, side) {
  const found = [];
  for (let cm = Math.ceil((middle - half) / spacing) * spacing; cm <= middle + half; cm += spacing) {
    found.push([cm, Math.round(((cm - middle + half) / (2 * half)) * side) + 0.5]);
  }
  return found;
}

function drawBorder(pen, segments, side, zoom, strength) {
  const at = (share) => ((share - 0.5) * zoom + 0.5) * side;
  outlined(pen, [['rgb(0 0 0 / 0.3)', 2.25], [`rgb(255 255 255 / ${strength})`, 1]], () => {
    for (let i = 0; i < segments.length; i += 4) {
      pen.moveTo(at(segments[i]), at(1 - segments[i + 1]));
      pen.lineTo(at(segments[i + 2]), at(1 - segments[i + 3]));
    }
  });
}

/** Particles, truth, estimates and, in contact, the line to the end effector; y is up. */
function drawMarks(pen, drawn, side, { cloud, zoom, hover }) {
  const { maps, trace, name } = drawn;
  const { centre, estimate, effector, step } = maps;
  const half = maps.half_width / zoom;
  const place = ([x, y]) => [((x - centre[0] + half) / (2 * half)) * side, ((centre[1] - y + half) / (2 * half)) * side];
  const [tx, ty] = place(centre);
  if (effector && trace.contact[step]) {
    pen.setLineDash([4, 4]);
    outlined(pen, [['rgb(255 255 255 / 0.8)', 1]], () => (pen.moveTo(tx, ty), pen.lineTo(...place(effector))));
    pen.setLineDash([]);
  }
  if (cloud) drawCloud(pen, drawn, place);
  // Open in the middle: a sharp peak is no larger than a mark.
  if (maps.truth[0] !== null) outlined(pen, [['rgb(0 0 0 / 0.6)', 3.5], ['#fff', 1.5]], () => {
    for (const [dx, dy] of [[1, 0], [0, 1], [-1, 0], [0, -1]]) {
      pen.moveTo(tx + 4 * dx, ty + 4 * dy);
      pen.lineTo(tx + 10 * dx, ty + 10 * dy);
    }
  });
  if (name !== 'fused' && trace.fuses) {
    const [x, y] = place(trace.position.map((i) => trace.mean(name, i)[step] / 100));
    outlined(pen, [HALO, [line(name).stroke, 2]], () => pen.arc(x, y, 5, 0, 2 * Math.PI));
  }
  const [x, y] = place(trace.position.map((i) => estimate[i]));
  outlined(pen, [HALO, [line('fused').stroke, 2]], () => {
    pen.moveTo(x, y - 9);
    for (const [dx, dy] of [[9, 0], [0, 9], [-9, 0], [0, -9]]) pen.lineTo(x + dx, y + dy);
  });
  if (!hover) return;
  const [hx, hy] = place([centre[0] + hover[0], centre[1] + hover[1]]);
  outlined(pen, [['rgb(0 0 0 / 0.35)', 2.5], ['rgb(255 255 255 / 0.8)', 1]], () => {
    pen.moveTo(0, hy);
    pen.lineTo(side, hy);
    pen.moveTo(hx, 0);
    pen.lineTo(hx, side);
  });
}

/** Particles: their area is their weight as the layer sets it, and those without fade. */
function drawCloud(pen, { maps, layer }, place) {
  const weights = maps.weights[layer];
  pen.lineWidth = 0.75;
  weights.forEach((weight, i) => {
    const share = weight * weights.length; // of the mean weight
    const [x, y] = place([maps.positions[2 * i], maps.positions[2 * i + 1]]);
    const alpha = Math.min(0.12 + 0.5 * share, 0.75).toFixed(2);
    pen.fillStyle = `rgb(255 255 255 / ${alpha})`;
    pen.strokeStyle = `rgb(0 0 0 / ${alpha})`;
    pen.beginPath();
    pen.arc(x, y, Math.min(Math.max(PARTICLE * Math.sqrt(share), 0.8), 9), 0, 2 * Math.PI);
    pen.fill();
    pen.stroke();
  });
}

function outlined(pen, strokes, draw) {
  for (const [style, width] of strokes) {
    [pen.strokeStyle, pen.lineWidth] = [style, width];
    pen.beginPath();
    draw();
    pen.stroke();
  }
}
