/** Small maps of several steps: the last one in free motion beside the first one in contact, and those around the cursor. */

/** @import { ColourMap } from '../core/palette.js' */
/** @import { Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { Cursor } from '../data/view_socket.js' */
/** @import { Maps, Scale } from './map_values.js' */

import { MAP_SIZE } from '../core/constants.js';
import { context2d, create, html } from '../core/dom.js';
import { displayName } from '../core/units.js';
import { paintCells } from './draw_map.js';
import { mapChoices } from './map_choices.js';
import { tileShade, tileSteps } from './map_values.js';

const GAP = 3; // px between tiles
const NAMES = 66; // px of the column with the names of the layers
const HEAD = 34; // px of the row with the steps
const MIN_SIDE = 28; // px
const MAX_KEPT = 200; // maps of other steps that are kept

/** @typedef {{maps: Maps, trace: Trace, layers: string[], zoom: number, content: string}} Shown */

export class MapTiles {
  #host;
  #store;
  #requestMaps;
  /** Maps by step, of one selection and content. @type {Map<number, Maps>} */
  #kept = new Map();
  #key = '';
  /** @type {Shown | null} */
  #shown = null;
  #loading = false;
  #cells = create('canvas');
  /** Content of each tile. @type {WeakMap<HTMLElement, {maps: Maps | null, style: string}>} */
  #painted = new WeakMap();

  /**
   * @param {HTMLElement} host
   * @param {Store} store
   * @param {(cursor: Cursor, size: number) => Promise<Maps | null>} requestMaps
   */
  constructor(host, store, requestMaps) {
    this.#host = host;
    this.#store = store;
    this.#requestMaps = requestMaps;
    new ResizeObserver(() => this.redraw()).observe(host);
    host.addEventListener('click', ({ target }) => {
      const tile = target instanceof Element && target.closest('button');
      if (tile) store.set({ step: Number(tile.dataset.step) });
    });
  }

  /** @param {Shown} shown maps at the cursor and how they are displayed */
  draw(shown) {
    const { maps, trace, content } = shown;
    const key = JSON.stringify([trace.selection, content, this.#store.state.angle]);
    if (key !== this.#key) this.#kept.clear();
    this.#key = key;
    this.#shown = shown;
    if (this.#kept.size > MAX_KEPT) this.#kept.clear();
    if (this.#kept.get(maps.step)?.size !== MAP_SIZE.fine) this.#kept.set(maps.step, maps);
    this.redraw();
    if (maps.size === MAP_SIZE.fine && !trace.live) this.#load(); // the cursor rests; live runs keep only the current maps
  }

  /** Requests the missing maps, one after the other, until the cursor moves. */
  async #load() {
    if (this.#loading || !this.#shown) return;
    this.#loading = true;
    const [key, { trace, maps }] = [this.#key, this.#shown];
    const { state } = this.#store;
    // The nearest step comes last, because the server then computes maps around it ahead of the cursor.
    const steps = tileSteps(trace.contact, maps.step).map(({ step }) => step);
    steps.sort((a, b) => Math.abs(b - maps.step) - Math.abs(a - maps.step));
    for (const step of steps) {
      if (this.#kept.has(step) || this.#host.hidden) continue;
      const cursor = { ...trace.selection, step, angle: state.angle, ...mapChoices(state, trace) };
      const tile = await this.#requestMaps(cursor, MAP_SIZE.coarse);
      if (!tile || key !== this.#key || state.step !== maps.step) break;
      this.#kept.set(step, tile);
      this.redraw();
    }
    this.#loading = false;
    const moved = this.#shown.maps;
    if (moved !== maps && moved.size === MAP_SIZE.fine) this.#load();
  }

  redraw() {
    const shown = this.#shown;
    if (!shown || this.#host.hidden) return;
    const { trace, maps, layers } = shown;
    const steps = tileSteps(trace.contact, maps.step);
    const { clientWidth, clientHeight } = this.#host;
    const side = Math.max(
      MIN_SIDE,
      Math.floor(
        Math.min(
          (clientWidth - NAMES) / steps.length - GAP,
          (clientHeight - HEAD) / layers.length - GAP,
        ),
      ),
    );
    this.#host.style.setProperty('--tiles', String(steps.length));
    this.#host.style.setProperty('--side', `${side}px`);
    this.#build(steps.length, layers.length);
    const buttons = this.#host.querySelectorAll('button');
    this.#host.querySelectorAll('.layer').forEach((name, i) => {
      name.textContent = displayName(layers[i]);
    });
    steps.forEach(({ step, phase, pair }, column) => {
      const head = buttons[column];
      const [label, text] = head.querySelectorAll('span');
      [label.textContent, text.textContent] = [String(step), phase];
      head.ariaLabel = `Step ${step}, ${phase}`;
      for (let row = 0; row <= layers.length; row++) {
        const button = buttons[row * steps.length + column];
        button.dataset.step = String(step);
        button.classList.toggle('current', step === maps.step);
        button.classList.toggle('pair', pair);
        if (row === 0) continue;
        button.title = `${displayName(layers[row - 1])}, step ${step}, ${phase}`;
        this.#paint(button, this.#kept.get(step) ?? null, row - 1, side);
      }
    });
  }

  /**
   * Creates the heads and tiles where their number changed.
   * @param {number} columns
   * @param {number} rows
   */
  #build(columns, rows) {
    const size = `${columns}x${rows}`;
    if (this.#host.dataset.size === size) return;
    this.#host.dataset.size = size;
    const heads = Array.from({ length: columns }, () =>
      create('button', { type: 'button', className: 'step' }, create('span'), create('span')),
    );
    const layers = Array.from({ length: rows }, () => [
      create('span', { className: 'layer' }),
      ...Array.from({ length: columns }, () =>
        create('button', { type: 'button', tabIndex: -1, ariaHidden: 'true' }, create('canvas')),
      ),
    ]);
    this.#host.replaceChildren(create('span', { textContent: 'step' }), ...heads, ...layers.flat());
  }

  /**
   * Paints a tile: the cells, and the true position as ticks at its borders.
   * @param {HTMLElement} tile
   * @param {Maps | null} maps null if not yet received
   * @param {number} row of the layer
   * @param {number} side px
   */
  #paint(tile, maps, row, side) {
    const canvas = /** @type {HTMLCanvasElement} */ (html('canvas', tile));
    const pixels = Math.round(side * devicePixelRatio);
    const { scale, colours } = this.#store.state;
    const style = [pixels, scale, colours, this.#shown?.zoom].join();
    const painted = this.#painted.get(tile);
    if (painted?.maps === maps && painted.style === style) return;
    this.#painted.set(tile, { maps, style });
    if (canvas.width !== pixels) [canvas.width, canvas.height] = [pixels, pixels];
    const context = context2d(canvas);
    context.clearRect(0, 0, pixels, pixels);
    if (!maps || !this.#shown) return;
    const layer = maps.layers.indexOf(this.#shown.layers[row]);
    const shade = tileShade(maps, layer, /** @type {Scale} */ (scale));
    paintCells(this.#cells, shade, maps.size, /** @type {ColourMap} */ (colours));
    const visible = maps.size / this.#shown.zoom;
    const start = (maps.size - visible) / 2;
    context.drawImage(this.#cells, start, start, visible, visible, 0, 0, pixels, pixels);
    if (maps.truth[maps.axes[0].index] === null) return;
    const [middle, tick] = [pixels / 2, Math.round(pixels / 12)];
    [context.strokeStyle, context.lineWidth] = ['#fff', devicePixelRatio];
    context.beginPath();
    for (const end of [0, pixels]) {
      const inner = end ? pixels - tick : tick;
      context.moveTo(middle, end);
      context.lineTo(middle, inner);
      context.moveTo(end, middle);
      context.lineTo(inner, middle);
    }
    context.stroke();
  }
}
