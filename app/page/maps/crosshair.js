/** The crosshair of the likelihood maps: it follows the pointer or the arrow keys, at the same offset on all maps. */

/** @import { Maps } from './map_values.js' */

import { MARGIN } from './draw_map.js';

/** @type {Record<string, number[]>} */
const ARROWS = {
  ArrowLeft: [-1, 0],
  ArrowRight: [1, 0],
  ArrowUp: [0, 1],
  ArrowDown: [0, -1],
};
const CELLS = { plain: 1, shift: 5 }; // of an arrow key

/**
 * @typedef {object} Geometry of the displayed maps
 * @property {Maps} maps
 * @property {number} zoom
 * @property {number} side px of the square of a map
 * @property {(layer: number) => number} leftMargin px
 */

export class Crosshair {
  /** Offset from the centre of the maps. @type {number[] | null} */
  offset = null;
  /** The map under the pointer, or with the focus. */
  layer = 0;
  #geometry;
  #changed;
  #announce;

  /**
   * @param {() => Geometry | null} geometry null without maps
   * @param {() => void} changed
   * @param {(offset: number[]) => void} announce called after a key
   */
  constructor(geometry, changed, announce) {
    this.#geometry = geometry;
    this.#changed = changed;
    this.#announce = announce;
  }

  /**
   * @param {HTMLCanvasElement} canvas
   * @param {number} layer
   */
  bind(canvas, layer) {
    canvas.addEventListener('pointermove', (event) => this.#point(event, layer));
    canvas.addEventListener('pointerleave', () => this.#move(null));
    canvas.addEventListener('pointerdown', (event) => event.preventDefault()); // keeps the focus
    canvas.addEventListener('keydown', (event) => this.#press(event, layer));
    canvas.addEventListener('blur', () => this.#move(null));
  }

  /** Its place in px in the window, on the map that it belongs to. @param {HTMLCanvasElement} canvas of this map */
  place(canvas) {
    const geometry = this.#geometry();
    if (!geometry || !this.offset) return null;
    const { maps, zoom, side, leftMargin } = geometry;
    const { left, top } = canvas.getBoundingClientRect();
    const [x, y = 0] = this.offset.map((d, i) => (d * zoom) / maps.axes[i].half_width);
    return {
      x: left + leftMargin(this.layer) + (side * (1 + x)) / 2,
      y: top + MARGIN.top + (side * (1 - y)) / 2,
    };
  }

  /**
   * @param {PointerEvent} event
   * @param {number} layer
   */
  #point(event, layer) {
    const geometry = this.#geometry();
    if (!geometry) return;
    const { maps, zoom, side, leftMargin } = geometry;
    const x = (event.offsetX - leftMargin(layer)) / side;
    const y = (event.offsetY - MARGIN.top) / side;
    this.#move(offsetAt(maps, zoom, x, y), layer);
  }

  /**
   * @param {KeyboardEvent} event
   * @param {number} layer
   */
  #press(event, layer) {
    if (event.key === 'Escape') this.#move(null);
    const [direction, geometry] = [ARROWS[event.key], this.#geometry()];
    if (!direction || !geometry) return;
    event.preventDefault();
    const cells = event.shiftKey ? CELLS.shift : CELLS.plain;
    const offset = moved(geometry.maps, geometry.zoom, this.offset, direction, cells);
    this.#move(offset, layer);
    this.#announce(offset);
  }

  /**
   * @param {number[] | null} offset
   * @param {number} [layer]
   */
  #move(offset, layer = 0) {
    if (offset === this.offset) return;
    [this.offset, this.layer] = [offset, layer];
    this.#changed();
  }
}

/**
 * Returns the offset at a place in the square of a map; null outside of it.
 * @param {Pick<Maps, 'axes'>} maps
 * @param {number} zoom
 * @param {number} x share of the side, from the left
 * @param {number} y from the top
 */
export function offsetAt({ axes }, zoom, x, y) {
  if (!(x >= 0 && x <= 1 && y >= 0 && y <= 1)) return null;
  return axes.map(({ half_width: half }, i) => ((i ? 1 - 2 * y : 2 * x - 1) * half) / zoom);
}

/**
 * Returns an offset moved by some cells, within the visible area.
 * @param {Pick<Maps, 'axes' | 'size'>} maps
 * @param {number} zoom
 * @param {number[] | null} from the centre for null
 * @param {number[]} direction
 * @param {number} cells
 */
export function moved({ axes, size }, zoom, from, direction, cells) {
  return axes.map(({ half_width: half }, i) => {
    const cell = (2 * half) / size;
    const limit = half / zoom - cell / 2;
    const target = (from?.[i] ?? 0) + cells * cell * direction[i];
    return Math.min(Math.max(target, -limit), limit);
  });
}
