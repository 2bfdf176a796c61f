/** Small maps of several steps: the last one in free motion beside the first one in contact, and those around the cursor. */

/** @import { Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { Cursor } from '../data/view_socket.js' */
/** @import { MapOptions } from './draw_map.js' */
/** @import { DisplayedMaps } from './map_panel.js' */
/** @import { MapReadout } from './map_readout.js' */
/** @import { Maps } from './map_values.js' */

import { MAP_SIZE } from '../core/constants.js';
import { context2d, create, html } from '../core/dom.js';
import { displayName } from '../core/units.js';
import { offsetAt } from './crosshair.js';
import { drawBorder, paintCells } from './draw_map.js';
import { mapChoices } from './map_choices.js';
import { showColourBar } from './map_figure.js';
import { positionText, tilesScale, valuesAt } from './map_summary.js';
import { REGION_SHARES, borders, tileShade, tileSteps } from './map_values.js';
import { content } from './reference_maps.js';

const GAP = 3; // px between tiles
const NAMES = 66; // px of the column with the names of the layers
const HEAD = 34; // px of the row with the steps
const MIN_SIDE = 28; // px
const MAX_KEPT = 200; // maps of other steps that are kept

/** @typedef {{maps: Maps, trace: Trace, layers: string[], zoom: number}} Shown */

export class MapTiles {
  #host;
  #store;
  #requestMaps;
  #readout;
  /** Maps by step, of one selection and content. @type {Map<number, Maps>} */
  #kept = new Map();
  #key = '';
  /** @type {Shown | null} */
  #displayed = null;
  #loading = false;
  #cells = create('canvas');
  /** Content of each tile. @type {WeakMap<HTMLElement, {maps: Maps | null, style: string}>} */
  #painted = new WeakMap();

  /**
   * @param {HTMLElement} host
   * @param {Store} store
   * @param {(cursor: Cursor, size: number) => Promise<Maps | null>} requestMaps
   * @param {MapReadout} readout
   */
  constructor(host, store, requestMaps, readout) {
    this.#host = host;
    this.#readout = readout;
    this.#store = store;
    this.#requestMaps = requestMaps;
    new ResizeObserver(() => this.redraw()).observe(host);
    host.addEventListener('click', ({ target }) => {
      const tile = target instanceof Element && target.closest('button');
      if (tile) store.set({ step: Number(tile.dataset.step) });
    });
    host.addEventListener('pointermove', (event) => this.#point(event));
    host.addEventListener('pointerleave', () => readout.hide());
  }

  /** @param {Shown} displayed maps at the cursor and how they are displayed */
  draw(displayed) {
    const { maps, trace } = displayed;
    const { angle, follow } = this.#store.state;
    const key = JSON.stringify([trace.selection, content(maps), angle]);
    if (key !== this.#key) this.#kept.clear();
    this.#key = key;
    this.#displayed = displayed;
    if (this.#kept.size > MAX_KEPT) this.#kept.clear();
    if (this.#kept.get(maps.step)?.size !== MAP_SIZE.fine) this.#kept.set(maps.step, maps);
    this.redraw();
    // The cursor rests. With the newest step of a live run, it moves before the maps of other steps arrive.
    if (maps.size === MAP_SIZE.fine && !(trace.live && follow)) this.#load();
  }

  /** Requests the missing maps, one after the other, coarse and then fine ones, until the cursor moves. */
  async #load() {
    if (this.#loading || !this.#displayed) return;
    this.#loading = true;
    const [key, { trace, maps }] = [this.#key, this.#displayed];
    const { state } = this.#store;
    // The nearest step comes last, because the server then computes maps around it ahead of the cursor.
    const steps = tileSteps(trace.contact, maps.step).map(({ step }) => step);
    steps.sort((a, b) => Math.abs(b - maps.step) - Math.abs(a - maps.step));
    const requests = [MAP_SIZE.coarse, MAP_SIZE.fine].flatMap((size) =>
      steps.map((step) => ({ step, size })),
    );
    for (const { step, size } of requests) {
      if ((this.#kept.get(step)?.size ?? 0) >= size || this.#host.hidden) continue;
      const cursor = { ...trace.selection, step, angle: state.angle, ...mapChoices(state, trace) };
      const tile = await this.#requestMaps(cursor, size);
      if (!tile || key !== this.#key || state.step !== maps.step) break;
      this.#kept.set(step, tile);
      this.redraw();
    }
    this.#loading = false;
    const moved = this.#displayed.maps;
    if (moved !== maps && moved.size === MAP_SIZE.fine) this.#load();
  }

  redraw() {
    const displayed = this.#displayed;
    if (!displayed || this.#host.hidden) return;
    const { trace, maps, layers } = displayed;
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
      head.ariaLabel = `Step ${step}${phase && `, ${phase}`}`;
      for (let row = 0; row <= layers.length; row++) {
        const button = buttons[row * steps.length + column];
        button.dataset.step = String(step);
        button.classList.toggle('current', step === maps.step);
        button.classList.toggle('pair', pair);
        if (row === 0) continue;
        [button.dataset.row, button.dataset.phase] = [String(row - 1), phase];
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
    const { scale, range, colours, regions } = this.#store.state;
    const style = [pixels, scale, range, colours, regions, this.#displayed?.zoom].join();
    const painted = this.#painted.get(tile);
    if (painted?.maps === maps && painted.style === style) return;
    this.#painted.set(tile, { maps, style });
    if (canvas.width !== pixels) [canvas.width, canvas.height] = [pixels, pixels];
    const context = context2d(canvas);
    context.clearRect(0, 0, pixels, pixels);
    if (!maps || !this.#displayed) return;
    tile.dataset.cells = String(maps.size);
    const layer = maps.layers.indexOf(this.#displayed.layers[row]);
    const { zoom } = this.#displayed;
    paintCells(this.#cells, this.#shade(maps, layer), maps.size, colours);
    const visible = maps.size / zoom;
    const start = (maps.size - visible) / 2;
    context.drawImage(this.#cells, start, start, visible, visible, 0, 0, pixels, pixels);
    for (const [i, segments] of this.#borders(maps, layer).entries())
      drawBorder(context, segments, pixels, zoom, i);
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

  /**
   * @param {Maps} maps
   * @param {number} layer
   */
  #shade(maps, layer) {
    const { scale, range } = this.#store.state;
    return tileShade(maps, layer, scale, range);
  }

  /**
   * @param {Maps} maps
   * @param {number} layer
   */
  #borders(maps, layer) {
    return this.#store.state.regions === 'shown' ? borders(maps, layer, REGION_SHARES) : [];
  }

  /** @param {HTMLElement} host shows the colour bar of all tiles */
  showColours(host) {
    if (!this.#displayed) return;
    host.hidden = false;
    const { colours } = this.#store.state;
    showColourBar(host, colours, this.#scale(this.#displayed.maps));
  }

  /** @param {Maps} maps of any step */
  #scale(maps) {
    const { scale, range } = this.#store.state;
    return tilesScale(maps.quantity, scale, range, this.#shade(maps, 0));
  }

  /**
   * Shows the values of the tile under the pointer.
   * @param {PointerEvent} event
   */
  #point({ target, clientX: x, clientY: y }) {
    const canvas = target instanceof HTMLCanvasElement ? target : null;
    const tile = canvas?.closest('button');
    const maps = this.#kept.get(Number(tile?.dataset.step));
    if (!canvas || !tile || !maps || !this.#displayed) return this.#readout.hide();
    const { left, top, width, height } = canvas.getBoundingClientRect();
    const offset = offsetAt(maps, this.#displayed.zoom, (x - left) / width, (y - top) / height);
    if (!offset) return this.#readout.hide();
    const name = this.#displayed.layers[Number(tile.dataset.row)];
    const position = positionText(maps, offset, this.#store.state.axes === 'world');
    const values = valuesAt(maps, maps.layers.indexOf(name), offset, null);
    const { phase } = tile.dataset;
    const title = `${displayName(name)}, step ${maps.step}${phase && `, ${phase}`}`;
    this.#readout.show(title, [position, ...values], { x, y });
  }

  /**
   * Returns the displayed maps of all steps that have arrived, for an export.
   * @param {MapOptions} options
   * @returns {DisplayedMaps[]}
   */
  sheets(options) {
    if (!this.#displayed) return [];
    const title = this.#scale(this.#displayed.maps).label;
    const { trace, layers, maps: current } = this.#displayed;
    const colourMap = this.#store.state.colours;
    return tileSteps(trace.contact, current.step).flatMap(({ step, phase }) => {
      const maps = this.#kept.get(step);
      if (!maps) return [];
      const drawn = layers.map((name) => {
        const index = maps.layers.indexOf(name);
        const [shade, cells] = [this.#shade(maps, index), create('canvas')];
        paintCells(cells, shade, maps.size, colourMap);
        return {
          ...{ name, index, maps, trace, cells, shade, colourMap },
          borders: this.#borders(maps, index),
        };
      });
      return [{ maps, trace, layers: drawn, title, options, phase }];
    });
  }
}
