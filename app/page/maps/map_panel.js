/** The panel with the likelihood maps, one per layer. */

/** @import { State, Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { Cursor } from '../data/view_socket.js' */
/** @import { Layer, MapOptions } from './draw_map.js' */
/** @import { Figure } from './map_figure.js' */
/** @import { Maps } from './map_values.js' */
/** @import { Reference } from './reference_maps.js' */

import { MAP_QUANTITIES } from '../core/constants.js';
import { context2d, html } from '../core/dom.js';
import { colour } from '../core/colours.js';
import { displayName, sentence } from '../core/units.js';
import { choice } from '../widgets/pickers.js';
import { Crosshair } from './crosshair.js';
import { drawCurve } from './draw_curve.js';
import { MARGIN, drawMap, paintCells } from './draw_map.js';
import { createFigure, showColourBar, showShape } from './map_figure.js';
import { CLOSE_UP, fitsCloseUp, isMany, mapLayout } from './map_layout.js';
import { showMeasures } from './map_measures.js';
import { MapTiles } from './map_tiles.js';
import { MapReadout } from './map_readout.js';
import {
  QUANTITY_NAMES,
  axesText,
  axesSubject,
  colourScale,
  colourTitle,
  layerMeasures,
  mapTitle,
  positionText,
  shapeName,
  valuesAt,
} from './map_summary.js';
import { REGION_SHARES, borders, isCurve, shades } from './map_values.js';
import { References } from './reference_maps.js';

/** @type {(keyof State)[]} */
const OPTIONS = ['scale', 'range', 'axes', 'colours', 'regions', 'cloud', 'zoom', 'tiles']; // keys of the state
const EXPLANATIONS = {
  likelihood: 'Likelihood of the observation given the state',
  posterior: 'Posterior of the state: prior times likelihood',
};
/**
 * @typedef {{trace: Trace, maps: Maps, layers: Layer[], title: string, options: MapOptions, phase?: string}} DisplayedMaps
 *   of one step
 */

export class MapPanel {
  /** Called when maps were pinned or released. */
  changed = () => {};
  #panel;
  #host;
  #store;
  /** @type {Figure[]} */
  #figures = [];
  /** @type {Maps | null} */
  #maps = null;
  /** @type {Trace | null} */
  #trace = null;
  #references;
  #crosshair;
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
    this.#host = html('#heatmaps', panel);
    this.#readout = new MapReadout(html('#maps-readout', panel));
    this.#tiles = new MapTiles(html('#map-tiles', panel), store, requestMaps, this.#readout);
    this.#references = new References(store, requestMaps, () => {
      this.#shade();
      this.changed();
    });
    this.#crosshair = new Crosshair(
      () => this.#geometry,
      () => this.redraw(),
      (offset) => this.#announce(offset),
    );
    new ResizeObserver(() => this.#resize()).observe(this.#host);
    store.when(['map'], () => this.#showSwitch());
    store.when(['tiles'], () => (this.#side = 0));
    store.when(OPTIONS, () => this.#shade());
    store.when(['pin'], () => this.#references.restore());
  }

  /**
   * Displays maps.
   * @param {Maps} maps
   * @param {Trace} trace
   * @param {string} [comparisonName] label of the comparison run
   */
  draw(maps, trace, comparisonName = '') {
    const rebuild = this.#maps === null || this.#maps.layers.join() !== maps.layers.join();
    // The zoom does not return to the close-up: axes that change from step to step are hard to read.
    this.#wide = (this.#wide && this.#trace === trace) || !fitsCloseUp(maps);
    [this.#maps, this.#trace] = [maps, trace];
    this.#panel.classList.toggle('no-expected', maps.expected === null);
    this.#panel.classList.toggle('curves', isCurve(maps));
    this.#panel.classList.toggle('single', !trace.fuses || maps.layers.length === 1);
    // With a single measurement model the fused map equals that of the model.
    if (rebuild)
      this.#build(trace.fuses || maps.layers.length === 1 ? maps.layers : trace.modalities);
    this.#references.follow(maps, trace, comparisonName);
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
    const selected = missing[this.#store.state.map] ? this.#maps.quantity : this.#store.state.map;
    choice(
      host,
      MAP_QUANTITIES.map((quantity) => [quantity, QUANTITY_NAMES[quantity]]),
      selected,
      (map) => this.#store.set({ map: /** @type {Maps['quantity']} */ (map) }),
    );
    host.querySelectorAll('input').forEach((input, i) => {
      const reason = missing[MAP_QUANTITIES[i]];
      input.disabled = Boolean(reason);
      const label = input.closest('label');
      if (label) label.title = reason ? sentence(reason) : `${EXPLANATIONS[MAP_QUANTITIES[i]]} (p)`;
    });
  }

  /** Pins the displayed maps as the reference of later ones, or releases the pinned ones. Maps of several steps have none. */
  togglePin() {
    if (!this.#isTiled) this.#references.toggle();
  }

  get pinned() {
    return this.#references.pinned;
  }

  /** The displayed maps for an export, of one step or several. @returns {DisplayedMaps[]} */
  get displayed() {
    const [maps, trace] = [this.#maps, this.#trace];
    if (!maps || !trace) return [];
    const options = this.#options(0);
    if (this.#isTiled) return this.#tiles.sheets({ ...options, cloud: false });
    const layers = this.#figures.map((figure, index) => ({ ...figure, index, maps, trace }));
    return [{ maps, trace, layers, title: this.#title(), options }];
  }

  get #isTiled() {
    return this.#panel.classList.contains('tiled');
  }

  #resize() {
    if (this.#isTiled) return;
    if (this.#figures.length) this.#side = this.#availableSide();
    this.redraw();
  }

  redraw() {
    const [maps, trace] = [this.#maps, this.#trace];
    if (!maps || !trace || this.#isTiled) return;
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
    const reference = tiled ? null : this.#references.current;
    this.#showTitle(reference);
    if (tiled) return;
    const layers = shades(maps, scale, range, reference?.maps ?? null);
    this.#figures.forEach((figure, layer) => {
      figure.shade = layers[layer];
      figure.colourMap = reference ? 'diverging' : colours;
      figure.borders =
        regions === 'shown' && !isCurve(maps) ? borders(maps, layer, REGION_SHARES) : [];
      if (!isCurve(maps)) paintCells(figure.cells, figure.shade, maps.size, figure.colourMap);
      figure.head.title = layerMeasures(maps, layer, this.#world).description;
    });
    const { label } = this.#showColours(maps, reference);
    const axes = axesText(maps, this.#world, isCurve(maps) ? label : '');
    html('#maps-axis-names', this.#panel).textContent = axes;
    this.redraw();
  }

  /**
   * Shows the small maps of several steps if they are selected; returns whether they are shown.
   * @param {Maps} maps
   */
  #showTiles(maps) {
    const tiled = this.#store.state.tiles === 'several' && !isCurve(maps);
    html('#map-tiles', this.#panel).hidden = !tiled;
    this.#panel.classList.toggle('tiled', tiled);
    if (!tiled || !this.#trace) return tiled;
    this.#crosshair.offset = null;
    this.#readout.hide();
    const layers = this.#figures.map(({ name }) => name);
    this.#tiles.draw({ maps, trace: this.#trace, layers, zoom: this.#zoom });
    this.#tiles.showColours(html('#maps-colour-bar', this.#panel));
    html('#maps-axis-names', this.#panel).textContent = axesText(maps, this.#world);
    return tiled;
  }

  /**
   * Shows the colour bar of maps over two components and returns its labels.
   * @param {Maps} maps
   * @param {Reference | null} reference
   */
  #showColours(maps, reference) {
    const bar = html('#maps-colour-bar', this.#panel);
    bar.hidden = isCurve(maps);
    const { scale, range } = this.#store.state;
    const layers = this.#figures.map(({ name, shade }, i) => ({
      name,
      shade,
      peak: maps.log_max[i],
    }));
    const labels = colourScale(maps.quantity, scale, range, layers, reference?.name ?? '');
    showColourBar(bar, this.#figures[0].colourMap, labels);
    return labels;
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
    const quantity = this.#maps?.quantity ?? 'likelihood';
    kind.textContent = log ? `Log ${quantity}` : QUANTITY_NAMES[quantity];
    if (reference) kind.textContent = `Change from ${reference.name}`;
    html('h2', this.#panel).title = this.#title();
    const title = this.#maps ? mapTitle(this.#maps) : '';
    html('#maps-rule', this.#panel).textContent = reference
      ? ` · ${title}`
      : title.replace(/^\w+/, '');
    html('#maps-of', this.#panel).hidden = Boolean(reference);
    html('#maps-quantity', this.#panel).textContent = this.#maps
      ? axesSubject(this.#maps, this.#trace?.task)
      : '';
  }

  /** Describes what the colours show. */
  #title() {
    const { scale, range } = this.#store.state;
    const reference = this.#isTiled ? null : this.#references.current;
    return colourTitle(this.#maps?.quantity ?? 'likelihood', scale, range, reference);
  }

  /** @param {string[]} layers */
  #build(layers) {
    this.#side = 0;
    for (const { figure } of this.#figures) figure.remove();
    this.#figures = layers.map((name) => createFigure(name, layers.length > 1));
    this.#figures.forEach(({ canvas }, layer) => this.#crosshair.bind(canvas, layer));
    this.#host.classList.toggle('many', isMany(layers.length));
    this.#host.append(...this.#figures.map(({ figure }) => figure));
  }

  /** Arranges the maps and returns the side of the square of each, in px. */
  #availableSide() {
    const count = this.#figures.length;
    const { clientWidth, clientHeight } = this.#host;
    const { paddingLeft, paddingRight, paddingTop, paddingBottom } = getComputedStyle(this.#host);
    const width = clientWidth - parseFloat(paddingLeft) - parseFloat(paddingRight);
    const height = clientHeight - parseFloat(paddingTop) - parseFloat(paddingBottom);
    this.#arrange(count);
    const { head } = this.#figures[0];
    const { columns, side } = mapLayout(count, width, height, head.offsetHeight);
    if (columns < count) this.#arrange(columns);
    return side;
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

  /** Left margin of a map, px. @param {number} layer */
  #leftMargin = (layer) => (layer % this.#columns === 0 ? MARGIN.left : MARGIN.gap);

  get #geometry() {
    const [maps, zoom, side] = [this.#maps, this.#zoom, this.#side];
    return maps && { maps, zoom, side, leftMargin: this.#leftMargin };
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
      hover: this.#crosshair.offset,
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
    const hover = this.#crosshair.offset;
    showShape(figure, hover ? [this.#shownValue(maps, index, hover)] : shapeName(maps, index));
    canvas.ariaLabel = `${name}: ${this.#title()}; ${figure.head.title}. Arrow keys read values.`;
  }

  /**
   * @param {Maps} maps
   * @param {number} layer
   * @param {number[]} offset
   */
  #values(maps, layer, offset) {
    const ratios = this.#references.current ? this.#figures[layer].shade.values : null;
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
   * Announces the values of all maps at an offset.
   * @param {number[]} offset
   */
  #announce(offset) {
    const maps = this.#maps;
    if (!maps) return;
    const values = this.#figures.map(
      ({ name }, i) => `${displayName(name)} ${this.#values(maps, i, offset).join(', ')}`,
    );
    html('#maps-announcement', this.#panel).textContent =
      `${positionText(maps, offset, this.#world)}: ${values.join('; ')}`;
  }

  /** Shows the values at the crosshair beside it. */
  #showReadout() {
    const { offset, layer } = this.#crosshair;
    const place = this.#figures[layer] && this.#crosshair.place(this.#figures[layer].canvas);
    if (!this.#maps || !offset || !place) return this.#readout.hide();
    const values = this.#values(this.#maps, layer, offset);
    this.#readout.show(positionText(this.#maps, offset, this.#world), values, place);
  }
}
