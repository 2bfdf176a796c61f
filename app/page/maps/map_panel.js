/** The panel with the likelihood maps, one per layer. */

/** @import { ColourMap } from '../core/palette.js' */
/** @import { Store } from '../core/state.js' */
/** @import { Selection } from '../data/api.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { Cursor } from '../data/view_socket.js' */
/** @import { Layer, MapOptions } from './draw_map.js' */
/** @import { Figure } from './map_figure.js' */
/** @import { Maps, Range, Scale } from './map_values.js' */

import { MAP_QUANTITIES } from '../core/constants.js';
import { context2d, html } from '../core/dom.js';
import { colour } from '../core/palette.js';
import { displayName, mainName, sentence } from '../core/units.js';
import { choice } from '../widgets/pickers.js';
import { drawCurve } from './draw_curve.js';
import { MARGIN, drawMap, paintCells } from './draw_map.js';
import { createFigure, showColourBar } from './map_figure.js';
import { showMeasures } from './map_measures.js';
import { MapTiles } from './map_tiles.js';
import { MapReadout } from './map_readout.js';
import {
  QUANTITY_NAMES,
  axesText,
  colourScale,
  layerMeasures,
  mapTitle,
  positionText,
  shapeName,
  valuesAt,
} from './map_summary.js';
import { borders, isCurve, shades, tileShade } from './map_values.js';
import { formatPin, parsePin } from './pin.js';
import { mapChoices } from './map_choices.js';

const OPTIONS = ['scale', 'range', 'axes', 'colours', 'regions', 'cloud', 'zoom', 'tiles']; // keys of the state
const EXPLANATIONS = {
  likelihood: 'Likelihood of the observation given the state',
  posterior: 'Posterior of the state: prior times likelihood',
};
const REGION_SHARES = [0.5, 0.95];
const CLOSE_UP = 4; // zoom while all maps of the run fit into it
const MIN_SIDE = 60; // px
const MAX_COLUMNS = 4;
/** @type {Record<string, number[]>} */
const ARROWS = {
  ArrowLeft: [-1, 0],
  ArrowRight: [1, 0],
  ArrowUp: [0, 1],
  ArrowDown: [0, -1],
};

/**
 * @typedef {{maps: Maps, selection: Selection}} Pinned
 * @typedef {{maps: Maps, name: string, selection: Selection | null}} Reference of likelihood ratios; selection: null for the comparison run
 * @typedef {{trace: Trace, maps: Maps, layers: Layer[], title: string, options: MapOptions}} DisplayedMaps
 */

export class MapPanel {
  /** Called when maps were pinned or released. */
  changed = () => {};
  #panel;
  #host;
  #store;
  #requestMaps;
  /** @type {Figure[]} */
  #figures = [];
  /** @type {Maps | null} */
  #maps = null;
  /** @type {Trace | null} */
  #trace = null;
  /** @type {Pinned | null} */
  #pinned = null;
  #requestedPin = '';
  #comparisonName = '';
  /** Offset of the crosshair. @type {number[] | null} */
  #hover = null;
  #hoverLayer = 0; // its map
  #readout;
  #tiles;
  /** Whether some maps of the run did not fit into the close-up. */
  #wide = false;
  #side = 0; // px
  #columns = 1; // maps in a row

  /**
   * @param {HTMLElement} panel
   * @param {Store} store
   * @param {(cursor: Cursor, size?: number) => Promise<Maps | null>} requestMaps requests the maps of another step, fine by default
   */
  constructor(panel, store, requestMaps) {
    this.#panel = panel;
    this.#store = store;
    this.#requestMaps = requestMaps;
    this.#host = html('#heatmaps', panel);
    this.#tiles = new MapTiles(html('#map-tiles', panel), store, requestMaps);
    this.#readout = new MapReadout(html('#maps-readout', panel));
    new ResizeObserver(() => this.#resize()).observe(this.#host);
    store.listen((_, changed) => {
      if (changed.has('map')) this.#showSwitch();
      if (changed.has('tiles')) this.#side = 0;
      if (OPTIONS.some((key) => changed.has(key))) this.#shade();
      if (changed.has('pin')) this.#restorePin();
    });
  }

  /**
   * Displays maps.
   * @param {Maps} maps
   * @param {Trace} trace
   * @param {string} [comparisonName] label of the comparison run
   */
  draw(maps, trace, comparisonName = '') {
    this.#comparisonName = comparisonName;
    const rebuild = this.#maps === null || this.#maps.layers.join() !== maps.layers.join();
    // The zoom does not return to the close-up: axes that change from step to step are hard to read.
    this.#wide = (this.#wide && this.#trace === trace) || !fitsCloseUp(maps);
    [this.#maps, this.#trace] = [maps, trace];
    this.#panel.classList.toggle('no-expected', maps.expected === null);
    // With a single measurement model the fused map equals that of the model.
    if (rebuild)
      this.#build(trace.fuses || maps.layers.length === 1 ? maps.layers : trace.modalities);
    const pinned = this.#pinned;
    if (pinned && content(pinned.maps) !== content(maps)) {
      [this.#pinned, this.#requestedPin] = [null, '']; // requested again, with the new quantity and axes
    } else if (
      pinned &&
      (pinned.selection.task !== trace.selection.task || !comparable(pinned.maps, maps))
    )
      this.togglePin();
    this.#restorePin();
    this.#showSwitch();
    this.#shade();
  }

  /** Shows the other quantity: likelihoods or posteriors. */
  switchQuantity() {
    const maps = this.#maps;
    const other = MAP_QUANTITIES.find((quantity) => quantity !== maps?.quantity);
    if (other && !this.#trace?.header.missing_quantities[other]) this.#store.set({ map: other });
  }

  /** Shows which quantities the filter has; one that it does not have has the reason as its tooltip. */
  #showSwitch() {
    if (!this.#maps || !this.#trace) return;
    const missing = this.#trace.header.missing_quantities;
    const host = html('#maps-map', this.#panel);
    const shown = missing[this.#store.state.map] ? this.#maps.quantity : this.#store.state.map;
    choice(
      host,
      MAP_QUANTITIES.map((quantity) => [quantity, QUANTITY_NAMES[quantity]]),
      shown,
      (map) => this.#store.set({ map: /** @type {Maps['quantity']} */ (map) }),
    );
    host.querySelectorAll('input').forEach((input, i) => {
      const reason = missing[MAP_QUANTITIES[i]];
      input.disabled = Boolean(reason);
      const label = input.closest('label');
      if (label) label.title = reason ? sentence(reason) : `${EXPLANATIONS[MAP_QUANTITIES[i]]} (p)`;
    });
  }

  /** Pins the displayed maps as the reference of later ones, or releases the pinned ones. */
  togglePin() {
    const [maps, trace] = [this.#maps, this.#trace];
    if (!maps || !trace) return;
    this.#setPinned(this.#pinned ? null : { maps, selection: trace.selection });
    const pin = this.#pinned ? formatPin(trace.selection, maps.step, this.#store.state.angle) : '';
    this.#store.set({ pin });
  }

  /** @param {Pinned | null} pinned */
  #setPinned(pinned) {
    this.#pinned = pinned;
    this.#shade();
    this.changed();
  }

  /** Follows the state: requests the maps of a pinned step that a link names, or releases them. */
  async #restorePin() {
    const { pin, task } = this.#store.state;
    if (!pin && this.#pinned) this.#setPinned(null);
    if (!pin || !this.#maps || this.#pinned || this.#requestedPin === pin) return;
    this.#requestedPin = pin;
    const { selection, step, angle } = parsePin(pin, task);
    const shown = content(this.#maps);
    const choices = mapChoices(this.#store.state, this.#trace);
    const maps = await this.#requestMaps({ ...selection, step, angle, ...choices });
    if (!maps || this.#store.state.pin !== pin || this.#pinned || shown !== content(this.#maps))
      return;
    if (comparable(maps, this.#maps)) this.#setPinned({ maps, selection });
    else this.#store.set({ pin: '' });
  }

  /** Maps to which the displayed ones are compared: the pinned ones, or those of the comparison run. @returns {Reference | null} */
  get #reference() {
    if (this.#pinned) return { ...this.#pinned, name: `step ${this.#pinned.maps.step}` };
    const beside = this.#maps?.beside;
    if (!beside || !this.#maps || !comparable(beside, this.#maps)) return null;
    return { maps: beside, name: this.#comparisonName, selection: null };
  }

  get pinned() {
    return this.#pinned;
  }

  /** The displayed maps, for an export. @returns {DisplayedMaps | null} */
  get displayed() {
    const [maps, trace] = [this.#maps, this.#trace];
    if (!maps || !trace) return null;
    return {
      maps,
      trace,
      layers: this.#figures.map((figure, index) => ({ ...figure, index, maps, trace })),
      title: this.#title(),
      options: this.#options(0),
    };
  }

  #resize() {
    if (this.#panel.classList.contains('tiled')) return;
    if (this.#figures.length) this.#side = this.#availableSide();
    this.redraw();
  }

  redraw() {
    const [maps, trace] = [this.#maps, this.#trace];
    if (!maps || !trace || this.#panel.classList.contains('tiled')) return;
    if (!this.#side) this.#side = this.#availableSide();
    this.#figures.forEach((figure, index) => this.#drawLayer(figure, { maps, trace, index }));
    this.#showReadout();
  }

  /** Computes the colours and borders of the maps. */
  #shade() {
    const maps = this.#maps;
    if (!maps) return;
    const { scale, range, colours, regions } = this.#store.state;
    if (html('#maps-options', this.#panel).matches(':popover-open')) this.showMeasures();
    const tiled = this.#showTiles(maps);
    const reference = tiled ? null : this.#reference;
    this.#showTitle(reference);
    if (tiled) return;
    const layers = shades(
      maps,
      /** @type {Scale} */ (scale),
      /** @type {Range} */ (range),
      reference?.maps ?? null,
    );
    this.#figures.forEach((figure, layer) => {
      figure.shade = layers[layer];
      figure.colourMap = reference ? 'diverging' : /** @type {ColourMap} */ (colours);
      figure.borders =
        regions === 'shown' && !isCurve(maps) ? borders(maps, layer, REGION_SHARES) : [];
      if (!isCurve(maps)) paintCells(figure.cells, figure.shade, maps.size, figure.colourMap);
      figure.head.title = layerMeasures(maps, layer, this.#world).description;
    });
    this.#showColours(maps, reference);
    html('#maps-axis-names', this.#panel).textContent = axesText(maps, this.#world);
    this.redraw();
  }

  /**
   * Shows the small maps of several steps if they are selected; returns whether they are shown.
   * @param {Maps} maps
   */
  #showTiles(maps) {
    const { tiles, scale, colours } = this.#store.state;
    const tiled = tiles === 'several' && !isCurve(maps);
    html('#map-tiles', this.#panel).hidden = !tiled;
    this.#panel.classList.toggle('tiled', tiled);
    if (!tiled || !this.#trace) return tiled;
    this.#hover = null;
    this.#readout.hide();
    const layers = this.#figures.map(({ name }) => name);
    const shown = { maps, trace: this.#trace, layers, zoom: this.#zoom, content: content(maps) };
    this.#tiles.draw(shown);
    const shade = tileShade(maps, 0, /** @type {Scale} */ (scale));
    const labels = colourScale(
      maps.quantity,
      /** @type {Scale} */ (scale),
      'own',
      [{ name: '', shade, peak: 0 }],
      '',
    );
    const bar = html('#maps-scale', this.#panel);
    bar.hidden = false;
    showColourBar(bar, /** @type {ColourMap} */ (colours), labels);
    html('#maps-axis-names', this.#panel).textContent = axesText(maps, false);
    return tiled;
  }

  /**
   * @param {Maps} maps
   * @param {Reference | null} reference
   */
  #showColours(maps, reference) {
    const bar = html('#maps-scale', this.#panel);
    bar.hidden = isCurve(maps);
    const { scale, range } = this.#store.state;
    const layers = this.#figures.map(({ name, shade }, i) => ({
      name,
      shade,
      peak: maps.log_max[i],
    }));
    const labels = colourScale(
      maps.quantity,
      /** @type {Scale} */ (scale),
      /** @type {Range} */ (range),
      layers,
      reference?.name ?? '',
    );
    showColourBar(bar, this.#figures[0].colourMap, labels);
  }

  /** Fills the table of measures in the menu. */
  showMeasures() {
    const menu = html('#maps-options', this.#panel);
    const layers = this.#figures.map(({ name }) => name);
    if (this.#maps) showMeasures(menu, this.#maps, layers, this.#world);
  }

  /** @param {Reference | null} reference */
  #showTitle(reference) {
    const log = this.#store.state.scale === 'log';
    const kind = html('#maps-kind', this.#panel);
    const shown = this.#maps?.quantity ?? 'likelihood';
    kind.textContent = log ? `Log ${shown}` : QUANTITY_NAMES[shown];
    if (reference) kind.textContent = `Gain over ${reference.name}`;
    html('h2', this.#panel).title = this.#title();
    const title = this.#maps ? mapTitle(this.#maps) : '';
    html('#maps-rule', this.#panel).textContent = reference
      ? ` · ${title}`
      : title.replace(/^\w+/, '');
    html('#maps-of', this.#panel).hidden = Boolean(reference);
    html('#maps-quantity', this.#panel).textContent = this.#subject();
  }

  /** Names the state components of the axes. */
  #subject() {
    const task = this.#trace?.task;
    const names = this.#maps?.axes.map(({ name }) => name) ?? [];
    const isPosition =
      task?.main.name === 'position' && names.join() === task.map.components.join();
    return isPosition ? mainName(task) : names.map(displayName).join(', ');
  }

  /** Describes what the colours show. */
  #title() {
    const { scale, range } = this.#store.state;
    const quantity = this.#maps?.quantity;
    const reference = this.#reference;
    if (reference) {
      const { selection, name } = reference;
      const run = selection
        ? `${name} (${selection.filter}, episode ${selection.episode})`
        : `the comparison run (${name})`;
      return `log of the ${quantity} relative to ${run}, both as densities over the displayed area`;
    }
    if (scale === 'log') return `log ${quantity}`;
    return `${quantity} relative to ${range === 'same' ? 'the highest' : 'its own'} peak`;
  }

  /** @param {string[]} layers */
  #build(layers) {
    this.#side = 0;
    for (const { figure } of this.#figures) figure.remove();
    this.#figures = layers.map((name) => createFigure(name, layers.length > 1));
    this.#figures.forEach(({ canvas }, layer) => this.#bindCanvas(canvas, layer));
    this.#host.classList.toggle('many', layers.length > MAX_COLUMNS);
    this.#host.append(...this.#figures.map(({ figure }) => figure));
  }

  /**
   * @param {HTMLCanvasElement} canvas
   * @param {number} layer
   */
  #bindCanvas(canvas, layer) {
    canvas.addEventListener('pointermove', (event) => this.#point(event, layer));
    canvas.addEventListener('pointerleave', () => this.#setHover(null));
    canvas.addEventListener('pointerdown', (event) => event.preventDefault()); // keeps the focus
    canvas.addEventListener('keydown', (event) => this.#moveCrosshair(event, layer));
    canvas.addEventListener('blur', () => this.#setHover(null));
  }

  /** Returns the side of a map's square that fits the panel, in px. */
  #availableSide() {
    const count = this.#figures.length;
    const { clientWidth, clientHeight } = this.#host;
    const { paddingLeft, paddingRight, paddingTop, paddingBottom } = getComputedStyle(this.#host);
    const width = clientWidth - parseFloat(paddingLeft) - parseFloat(paddingRight);
    const height = clientHeight - parseFloat(paddingTop) - parseFloat(paddingBottom);
    this.#arrange(count);
    const { head } = this.#figures[0];
    /** @param {number} rows */
    const side = (rows) => {
      const columns = Math.ceil(count / rows);
      const horizontal =
        (width - MARGIN.left - (columns - 1) * MARGIN.gap - columns * MARGIN.right) / columns;
      const vertical = height / rows - MARGIN.bottom - MARGIN.top - head.offsetHeight;
      return Math.floor(Math.min(horizontal, vertical));
    };
    const [one, two] = [side(1), count > MAX_COLUMNS ? side(2) : 0];
    if (two > one) this.#arrange(Math.ceil(count / 2));
    return Math.max(MIN_SIDE, one, two);
  }

  /**
   * Arranges the maps in rows.
   * @param {number} columns
   */
  #arrange(columns) {
    this.#columns = columns;
    this.#host.style.setProperty('--columns', String(columns));
    this.#host.classList.toggle('two-rows', columns < this.#figures.length);
    this.#figures.forEach(({ figure }, layer) => {
      figure.classList.toggle('row-start', layer % columns === 0);
    });
  }

  get #zoom() {
    const { zoom } = this.#store.state;
    return zoom === 'fit' ? (this.#wide ? 1 : CLOSE_UP) : Number(zoom);
  }

  get #world() {
    return this.#store.state.axes === 'world';
  }

  /** @param {number} layer */
  #leftMargin(layer) {
    return layer % this.#columns === 0 ? MARGIN.left : MARGIN.gap;
  }

  /**
   * @param {number} layer
   * @returns {MapOptions}
   */
  #options(layer) {
    const { axes, cloud } = this.#store.state;
    return {
      axes,
      zoom: this.#zoom,
      cloud: cloud === 'shown',
      textColour: colour('muted'),
      withY: layer % this.#columns === 0,
      named: false,
      hover: this.#hover,
    };
  }

  /**
   * @param {Figure} figure
   * @param {{maps: Maps, trace: Trace, index: number}} layer
   */
  #drawLayer(figure, { maps, trace, index }) {
    const { canvas, name } = figure;
    const [side, left, ratio] = [this.#side, this.#leftMargin(index), devicePixelRatio];
    const [width, height] = [left + side + MARGIN.right, MARGIN.top + side + MARGIN.bottom];
    const [pixelWidth, pixelHeight] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (canvas.width !== pixelWidth || canvas.height !== pixelHeight) {
      [canvas.width, canvas.height] = [pixelWidth, pixelHeight];
      [canvas.style.width, canvas.style.height] = [`${width}px`, `${height}px`];
      figure.figure.style.width = `${width}px`;
    }
    const context = context2d(canvas);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    context.translate(left, MARGIN.top);
    const draw = isCurve(maps) ? drawCurve : drawMap;
    draw(context, { ...figure, index, maps, trace }, side, this.#options(index));
    figure.shape.textContent = this.#hover
      ? this.#shownValue(maps, index, this.#hover)
      : shapeName(maps, index);
    canvas.ariaLabel = `${name}: ${this.#title()}; ${figure.head.title}. Arrow keys read values.`;
  }

  /**
   * @param {Maps} maps
   * @param {number} layer
   * @param {number[]} offset
   */
  #values(maps, layer, offset) {
    const ratios = this.#reference ? this.#figures[layer].shade.values : null;
    return valuesAt(maps, layer, offset, ratios);
  }

  /**
   * Returns the value in the units of the colours.
   * @param {Maps} maps
   * @param {number} layer
   * @param {number[]} offset
   */
  #shownValue(maps, layer, offset) {
    const [relative, log, gain] = this.#values(maps, layer, offset);
    return gain ?? (this.#store.state.scale === 'log' ? log : relative);
  }

  /**
   * @param {PointerEvent} event
   * @param {number} layer
   */
  #point(event, layer) {
    if (!this.#maps) return;
    const [halfX, halfY] = this.#maps.axes.map((axis) => axis.half_width / this.#zoom);
    const x = (event.offsetX - this.#leftMargin(layer)) / this.#side;
    const y = (event.offsetY - MARGIN.top) / this.#side;
    const inside = x >= 0 && x <= 1 && y >= 0 && y <= 1;
    const offset = [(2 * x - 1) * halfX, (1 - 2 * y) * halfY];
    this.#setHover(inside ? offset.slice(0, this.#maps.axes.length) : null, layer);
  }

  /**
   * Moves the crosshair cell by cell with the arrow keys and announces the values.
   * @param {KeyboardEvent} event
   * @param {number} layer
   */
  #moveCrosshair(event, layer) {
    if (event.key === 'Escape') this.#setHover(null);
    const direction = ARROWS[event.key];
    const maps = this.#maps;
    if (!direction || !maps) return;
    event.preventDefault();
    const from = this.#hover ?? [0, 0];
    const offset = direction.slice(0, maps.axes.length).map((d, i) => {
      const { half_width: half } = maps.axes[i];
      const cell = (2 * half) / maps.size;
      const limit = half / this.#zoom - cell / 2;
      return Math.min(Math.max(from[i] + (event.shiftKey ? 5 : 1) * cell * d, -limit), limit);
    });
    this.#setHover(offset, layer);
    const values = this.#figures.map(
      ({ name }, i) => `${displayName(name)} ${this.#values(maps, i, offset).join(', ')}`,
    );
    html('#maps-announcement', this.#panel).textContent =
      `${positionText(maps, offset, this.#world)}: ${values.join('; ')}`;
  }

  /**
   * @param {number[] | null} offset
   * @param {number} [layer]
   */
  #setHover(offset, layer = 0) {
    if (offset === this.#hover) return;
    [this.#hover, this.#hoverLayer] = [offset, layer];
    this.redraw();
  }

  /** Shows the values at the crosshair beside it. */
  #showReadout() {
    const [maps, offset] = [this.#maps, this.#hover];
    const pointed = this.#figures[this.#hoverLayer];
    if (!maps || !offset || !pointed) return this.#readout.hide();
    const { left, top } = pointed.canvas.getBoundingClientRect();
    const [x, y] = offset.map((d, i) => (d * this.#zoom) / maps.axes[i].half_width);
    const values = this.#values(maps, this.#hoverLayer, offset);
    this.#readout.show(positionText(maps, offset, this.#world), values, {
      x: left + this.#leftMargin(this.#hoverLayer) + (this.#side * (1 + x)) / 2,
      y: top + MARGIN.top + (this.#side * (1 - (y ?? 0))) / 2,
    });
  }
}

/**
 * Identifies the quantity, the axes and the treatment of the other components of maps.
 * @param {Maps} maps
 */
const content = ({ quantity, axes, others }) =>
  [quantity, others, ...axes.map(({ name }) => name)].join();

/**
 * @param {Maps} a
 * @param {Maps} b
 */
const comparable = (a, b) =>
  a.layers.join() === b.layers.join() &&
  content(a) === content(b) &&
  a.axes.every(({ half_width: half }, i) => Math.abs(half / b.axes[i].half_width - 1) < 1e-5);

/**
 * Returns whether peaks and 95 % regions, approximated by ellipses, fit into the close-up.
 * @param {Maps} maps
 */
function fitsCloseUp({ axes, peak, numbers }) {
  const [halfX, halfY] = axes.map(({ half_width: half }) => half);
  if (axes.length === 1)
    return peak.every(
      ([offset], layer) => Math.abs(offset) + numbers.area95[layer] / 2 <= halfX / CLOSE_UP,
    );
  return peak.every((offset, layer) => {
    const area = numbers.area95[layer] / (halfX * halfY);
    const radius = Math.sqrt((area / Math.PI) * (numbers.elongation[layer] ?? 1));
    const farthest = Math.max(Math.abs(offset[0]) / halfX, Math.abs(offset[1]) / halfY);
    return farthest + radius <= 1 / CLOSE_UP;
  });
}
