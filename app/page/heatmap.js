/** The likelihood maps, one a layer, side by side: offsets in cm from the true position, each relative to its own peak. */

import { COLOUR_TABLE, colour, line, variable } from './palette.js';
import { fixed, signed } from './units.js';

const MARGIN = { left: 34, bottom: 30, top: 1, right: 5, gap: 9 }; // px around a map's square
const SPACINGS = [1, 2, 5, 10, 20, 50, 100]; // cm between ticks
const APART = 26; // px between them at least
const SMALLEST = Math.log(0.5 / 255); // below this a byte is 0
const HALO = ['rgb(255 255 255 / 0.55)', 3.5];
const FONT = '10px system-ui, sans-serif';

export class Heatmaps {
  #host;
  #figures = [];
  #maps = null;
  #trace = null;
  #hover = null; // [dx, dy] m
  #side = 0;

  /** @param {HTMLElement} host */
  constructor(host) {
    this.#host = host;
    new ResizeObserver(() => this.redraw()).observe(host);
  }

  /** @param {import('./socket.js').Maps} maps @param {import('./trace.js').Trace} trace that they are of. */
  draw(maps, trace) {
    const first = this.#maps === null || this.#maps.layers.join() !== maps.layers.join();
    maps.values = maps.cells.map((cells, l) => Uint8Array.from(cells, (q) => 255 * Math.exp(maps.log_range[l] * (q / 65535 - 1)) + 0.5));
    [this.#maps, this.#trace] = [maps, trace];
    // Of one measurement model alone the fused map is the same again.
    if (first) this.#figures = this.#build(trace.fuses || !trace.modalities.length ? maps.layers : trace.modalities);
    this.redraw();
  }

  redraw() {
    if (!this.#maps) return;
    this.#side = this.#fit();
    this.#figures.forEach((figure, layer) => this.#drawLayer(figure, layer));
  }

  #build(layers) {
    this.#host.querySelectorAll('figure').forEach((figure) => figure.remove());
    const fuses = layers.length > 1;
    return layers.map((name, layer) => {
      const figure = document.createElement('figure');
      figure.innerHTML = '<h3></h3><canvas role="img"></canvas><figcaption></figcaption>';
      figure.style.setProperty('--line', `var(${variable(fuses ? name : 'fused')})`);
      const [title, canvas, caption] = figure.children;
      title.textContent = (fuses || name !== 'fused' ? name : 'estimate').replaceAll('+', ' + ');
      canvas.addEventListener('pointermove', (event) => this.#point(event, layer));
      canvas.addEventListener('pointerleave', () => this.#point(null, layer));
      this.#host.append(figure);
      return { name, canvas, caption, cells: document.createElement('canvas') };
    });
  }

  /** Side of a map's square, px, that fits the panel. */
  #fit() {
    const count = this.#figures.length;
    const { clientWidth, clientHeight } = this.#host;
    const style = getComputedStyle(this.#host);
    const width = clientWidth - parseFloat(style.paddingLeft) - parseFloat(style.paddingRight);
    const across = (width - MARGIN.left - (count - 1) * MARGIN.gap - count * MARGIN.right) / count;
    const text = 38; // title and caption
    return Math.max(60, Math.floor(Math.min(across, clientHeight - MARGIN.bottom - MARGIN.top - text)));
  }

  #left(layer) {
    return layer === 0 ? MARGIN.left : MARGIN.gap;
  }

  #drawLayer({ name, canvas, caption, cells }, layer) {
    const maps = this.#maps;
    const side = this.#side;
    const left = this.#left(layer);
    const ratio = devicePixelRatio;
    const [width, height] = [left + side + MARGIN.right, MARGIN.top + side + MARGIN.bottom];
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
      [canvas.style.width, canvas.style.height] = [`${width}px`, `${height}px`];
    }
    paint(cells, maps.values[layer], maps.size);
    const pen = canvas.getContext('2d');
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.save();
    pen.translate(left, MARGIN.top);
    pen.drawImage(cells, 0, 0, side, side);
    this.#drawAxes(pen, side, layer === 0);
    pen.beginPath();
    pen.rect(0, 0, side, side);
    pen.clip();
    this.#drawMarks(pen, side, name);
    pen.restore();
    const [dx, dy] = maps.peak[layer].map((v) => signed(100 * v));
    canvas.setAttribute('aria-label', `${name}: likelihood over offsets from the truth, peak at ${dx}, ${dy} cm`);
    caption.textContent = this.#hover ? this.#valueAt(layer) : `peak ${dx}, ${dy} cm`;
    caption.title = `ln likelihood at the peak: ${fixed(maps.log_max[layer], 2)}`;
  }

  #drawAxes(pen, side, withY) {
    const half = 100 * this.#maps.half_width;
    const spacing = SPACINGS.find((cm) => (cm / (2 * half)) * side > APART) ?? 2 * half;
    pen.font = FONT;
    pen.fillStyle = colour('muted');
    pen.strokeStyle = colour('muted');
    pen.lineWidth = 1;
    pen.textBaseline = 'top';
    pen.textAlign = 'center';
    pen.beginPath();
    for (let cm = -Math.floor(half / spacing) * spacing; cm <= half; cm += spacing) {
      const at = Math.round(((cm + half) / (2 * half)) * side) + 0.5;
      pen.moveTo(at, side);
      pen.lineTo(at, side + 3);
      pen.fillText(fixed(cm, 0), at, side + 5);
      if (!withY) continue;
      pen.moveTo(0, side - at);
      pen.lineTo(-3, side - at);
      pen.save();
      pen.textAlign = 'right';
      pen.textBaseline = 'middle';
      pen.fillText(fixed(cm, 0), -5, side - at);
      pen.restore();
    }
    pen.stroke();
    pen.fillText('Δx (cm)', side / 2, side + 18);
    if (!withY) return;
    pen.save();
    pen.translate(-MARGIN.left + 1, side / 2);
    pen.rotate(-Math.PI / 2);
    pen.fillText('Δy (cm)', 0, 0);
    pen.restore();
  }

  /** Truth, estimates and the line to the end effector; y is up. */
  #drawMarks(pen, side, name) {
    const { half_width: half, centre, estimate, effector, step } = this.#maps;
    const place = ([x, y]) => [((x - centre[0] + half) / (2 * half)) * side, ((centre[1] - y + half) / (2 * half)) * side];
    const positionOf = (source) => this.#trace.position.map((i) => this.#trace.mean(source, i)[step] / 100);
    const outlined = (colours, draw) => {
      for (const [style, width] of colours) {
        [pen.strokeStyle, pen.lineWidth] = [style, width];
        pen.beginPath();
        draw();
        pen.stroke();
      }
    };
    const [tx, ty] = place(centre);
    if (effector) {
      pen.setLineDash([4, 4]);
      outlined([['rgb(255 255 255 / 0.75)', 1]], () => (pen.moveTo(tx, ty), pen.lineTo(...place(effector))));
      pen.setLineDash([]);
    }
    // Open in the middle: a sharp peak is no larger than a mark.
    outlined([['rgb(0 0 0 / 0.6)', 3.5], ['#fff', 1.5]], () => {
      for (const [dx, dy] of [[1, 0], [0, 1], [-1, 0], [0, -1]]) {
        pen.moveTo(tx + 4 * dx, ty + 4 * dy);
        pen.lineTo(tx + 10 * dx, ty + 10 * dy);
      }
    });
    if (name !== 'fused' && this.#trace.fuses) {
      const [x, y] = place(positionOf(name));
      outlined([HALO, [line(name).stroke, 2]], () => pen.arc(x, y, 5, 0, 2 * Math.PI));
    }
    const [x, y] = place(this.#trace.position.map((i) => estimate[i]));
    outlined([HALO, [line('fused').stroke, 2]], () => {
      pen.moveTo(x, y - 9);
      for (const [dx, dy] of [[9, 0], [0, 9], [-9, 0]]) pen.lineTo(x + dx, y + dy);
      pen.closePath();
    });
    if (!this.#hover) return;
    const [hx, hy] = place([centre[0] + this.#hover[0], centre[1] + this.#hover[1]]);
    outlined([['rgb(255 255 255 / 0.6)', 1]], () => {
      pen.moveTo(0, hy);
      pen.lineTo(side, hy);
      pen.moveTo(hx, 0);
      pen.lineTo(hx, side);
    });
  }

  #valueAt(layer) {
    const { size, half_width: half, values } = this.#maps;
    const [column, row] = this.#hover.map((d) => Math.min(Math.max(Math.floor(((d + half) / (2 * half)) * size), 0), size - 1));
    const byte = values[layer][row * size + column];
    const log = byte ? fixed(Math.log(byte / 255), 2) : `< ${fixed(SMALLEST, 1)}`;
    return `${fixed(byte / 255, 3)} of peak, ln ${log}`;
  }

  #point(event, layer) {
    if (!this.#maps) return;
    const { half_width: half } = this.#maps;
    this.#hover = null;
    if (event) {
      const x = (event.offsetX - this.#left(layer)) / this.#side;
      const y = (event.offsetY - MARGIN.top) / this.#side;
      if (x >= 0 && x <= 1 && y >= 0 && y <= 1) this.#hover = [(2 * x - 1) * half, (1 - 2 * y) * half];
    }
    const where = this.#hover?.map((d) => signed(100 * d));
    document.querySelector('#maps-value').textContent = where ? `at ${where[0]}, ${where[1]} cm` : '';
    this.redraw();
  }
}

/** Bytes to colours, turned over so that y is up. */
function paint(canvas, values, size) {
  if (canvas.width !== size || canvas.height !== size) [canvas.width, canvas.height] = [size, size];
  const pen = canvas.getContext('2d');
  const image = pen.createImageData(size, size);
  const pixels = new Uint32Array(image.data.buffer);
  for (let row = 0; row < size; row++) {
    const to = (size - 1 - row) * size;
    for (let column = 0; column < size; column++) pixels[to + column] = COLOUR_TABLE[values[row * size + column]];
  }
  pen.putImageData(image, 0, 0);
}

/** The colour bar: every colour once. @param {HTMLCanvasElement} canvas 256 x 1 */
export function paintColourBar(canvas) {
  const image = new ImageData(256, 1);
  new Uint32Array(image.data.buffer).set(COLOUR_TABLE);
  canvas.getContext('2d').putImageData(image, 0, 0);
}
