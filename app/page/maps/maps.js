/** The likelihood maps, one a layer, side by side, with their numbers beneath. */

import { MARGIN, drawMap, paint } from './draw_map.js';
import { borders, cellAt, digits, ends, shades, valueAt } from './map_values.js';
import { colour, gradient, variable } from '../core/palette.js';
import { fixed, percent, signed, spoken } from '../core/units.js';

const LOOKS = ['scale', 'range', 'axes', 'colours', 'regions', 'cloud', 'zoom']; // of the state
const SHARES = [0.5, 0.95]; // of the likelihood, that the regions hold
const ROUND = 1.3; // times as long as wide below which a map has no axis
const CLOSE = 4; // times that maps are magnified, as long as all of the run's fit
const DIVERGING = 'diverging';

export class Heatmaps {
  #panel;
  #host;
  #store;
  #figures = [];
  #maps = null;
  #trace = null;
  #pinned = null; // {maps, selection}
  #fetch;
  #fetched = ''; // the moment whose maps were asked for, to be pinned
  #besideName = '';
  #hover = null; // [dx, dy] m
  #wide = false; // whether maps of this run did not fit into the middle
  #side = 0;

  /**
   * @param {HTMLElement} panel with `#heatmaps` inside @param {import('../core/state.js').Store} store
   * @param {(moment: object) => Promise<import('./map_values.js').Maps>} fetch the fine maps of another moment
   */
  constructor(panel, store, fetch) {
    [this.#panel, this.#store, this.#fetch] = [panel, store, fetch];
    this.#host = panel.querySelector('#heatmaps');
    new ResizeObserver(() => this.#resize()).observe(this.#host);
    store.listen((_, changed) => LOOKS.some((look) => changed.has(look)) && this.#shade());
    store.listen((_, changed) => changed.has('pin') && this.#takePin());
  }

  /**
   * @param {import('./map_values.js').Maps} maps @param {import('../data/trace.js').Trace} trace that they are of
   * @param {string} besideName of the other run, whose maps may be beside them
   */
  draw(maps, trace, besideName = '') {
    this.#besideName = besideName;
    const first = this.#maps === null || this.#maps.layers.join() !== maps.layers.join();
    // Once they did not, they stay whole: axes that change from step to step cannot be read.
    this.#wide = (this.#wide && this.#trace === trace) || !fits(maps);
    [this.#maps, this.#trace] = [maps, trace];
    // Of one measurement model alone the fused map is the same again.
    if (first) this.#figures = this.#build(trace.fuses || !trace.modalities.length ? maps.layers : trace.modalities);
    const kept = this.#pinned;
    if (kept && (kept.selection.task !== trace.selection.task || !comparable(kept.maps, maps))) this.pin(); // lets them go
    this.#takePin();
    this.#shade();
  }

  /** Keeps these maps, to show what others gain or lose against them; or lets those go. */
  pin() {
    if (!this.#maps) return;
    this.#keep(this.#pinned ? null : { maps: this.#maps, selection: this.#trace.selection });
    const { angle } = this.#store.state;
    this.#store.set({ pin: this.#pinned ? moment(this.#trace.selection, this.#maps.step, angle) : '' });
  }

  #keep(pinned) {
    this.#pinned = pinned;
    this.#shade();
    this.changed();
  }

  /** The state names a moment whose maps are not here, as a link does: asks for them. Or it names none any more. */
  async #takePin() {
    const { pin, task } = this.#store.state;
    if (!pin && this.#pinned) this.#keep(null);
    if (!pin || !this.#trace || this.#pinned || this.#fetched === pin) return;
    this.#fetched = pin;
    const { step, angle = null, episode, ...named } = Object.fromEntries(new URLSearchParams(pin));
    const selection = { faults: '', ...named, task, episode: Number(episode) };
    const maps = await this.#fetch({ ...selection, step: Number(step), angle: angle && Number(angle) });
    if (this.#store.state.pin !== pin || this.#pinned) return;
    if (comparable(maps, this.#maps)) this.#keep({ maps, selection });
    else this.#store.set({ pin: '' });
  }

  /** The maps that the shown ones are set against: those pinned, or the other run's at this step; null without any. */
  get #base() {
    const beside = this.#maps?.beside;
    return this.#pinned ?? (beside && comparable(beside, this.#maps) ? { maps: beside, name: this.#besideName } : null);
  }

  /** What the base is called. */
  get #baseName() {
    return this.#base.name ?? `step ${this.#base.maps.step}`;
  }

  /** Set by who must know that the pinned maps have come or gone. */
  changed = () => {};

  get pinned() {
    return this.#pinned;
  }

  /** What is shown, for a file. @returns {{maps: object, trace: object, figures: object[], title: string, look: object}} */
  get shown() {
    const figures = this.#figures.map((figure, layer) => this.#drawn(figure, layer));
    return { maps: this.#maps, trace: this.#trace, figures, title: this.#title(), look: this.#look(0), pinned: this.#base };
  }

  /** Reads the layout, which costs: only where it may have changed. */
  #resize() {
    if (this.#figures.length) this.#side = this.#fit();
    this.redraw();
  }

  redraw() {
    if (!this.#maps) return;
    if (!this.#side) this.#side = this.#fit();
    this.#figures.forEach((figure, layer) => this.#drawLayer(figure, layer));
  }

  /** Colours and borders anew: for other maps, or other looks. */
  #shade() {
    if (!this.#maps) return;
    const { scale, range, colours, regions } = this.#store.state;
    const base = this.#base;
    const all = shades(this.#maps, scale, range, base?.maps ?? null);
    const table = base ? DIVERGING : colours;
    this.#figures.forEach((figure, layer) => {
      figure.shade = all[layer];
      figure.table = table;
      figure.borders = regions === 'shown' ? borders(this.#maps, layer, SHARES) : [];
      paint(figure.cells, all[layer], this.#maps.size, table);
      this.#showBar(figure);
    });
    const kind = this.#panel.querySelector('#maps-kind');
    kind.textContent = base ? `Gain on ${this.#baseName}` : scale === 'log' ? 'Log-likelihood' : 'Likelihood';
    kind.parentElement.title = this.#title();
    kind.nextElementSibling.hidden = Boolean(base);
    kind.nextElementSibling.classList.toggle('roomy', scale === 'log');
    this.#showPairs();
    this.redraw();
  }

  /** What the colours say, in words. */
  #title() {
    const { scale, range } = this.#store.state;
    if (this.#base?.name) return `ln of the likelihood over that of the other run (${this.#baseName}), each as a density over the square`;
    if (this.#pinned) {
      const { filter, episode } = this.#pinned.selection;
      return `ln of the likelihood over that of step ${this.#pinned.maps.step} (${filter}, episode ${episode}), each as a density over the square`;
    }
    if (scale === 'log') return 'ln likelihood';
    return range === 'same' ? 'likelihood over the highest peak of all' : 'likelihood over its own peak';
  }

  #build(layers) {
    this.#side = 0;
    this.#host.querySelectorAll('figure').forEach((figure) => figure.remove());
    const fuses = layers.length > 1;
    return layers.map((name, layer) => {
      const figure = document.createElement('figure');
      figure.innerHTML =
        '<div class="head"><h3></h3><span class="colours"><b></b><i></i><b></b></span></div><canvas role="img" tabindex="0"></canvas><figcaption><p></p><p></p><p></p></figcaption>';
      figure.style.setProperty('--line', `var(${variable(fuses ? name : 'fused')})`);
      const [head, canvas, caption] = figure.children;
      head.children[0].textContent = (fuses || name !== 'fused' ? name : 'estimate').replaceAll('+', ' + ');
      canvas.addEventListener('pointermove', (event) => this.#point(event, layer));
      canvas.addEventListener('pointerleave', () => this.#probe(null));
      canvas.addEventListener('pointerdown', (event) => event.preventDefault()); // the page's keys stay the page's
      canvas.addEventListener('keydown', (event) => this.#walk(event));
      canvas.addEventListener('blur', () => this.#probe(null));
      this.#host.append(figure);
      return { name, canvas, bar: head.children[1], lines: [...caption.children], caption, cells: document.createElement('canvas') };
    });
  }

  /** Side of a map's square, px, that fits the panel. */
  #fit() {
    const count = this.#figures.length;
    const { clientWidth, clientHeight } = this.#host;
    const style = getComputedStyle(this.#host);
    const width = clientWidth - parseFloat(style.paddingLeft) - parseFloat(style.paddingRight);
    const across = (width - MARGIN.left - (count - 1) * MARGIN.gap - count * MARGIN.right) / count;
    const { caption, bar } = this.#figures[0];
    const text = caption.offsetHeight + bar.parentElement.offsetHeight + parseFloat(style.paddingTop) + parseFloat(style.paddingBottom);
    return Math.max(60, Math.floor(Math.min(across, clientHeight - MARGIN.bottom - MARGIN.top - text)));
  }

  /** Half of the shown square's side, m. */
  get #half() {
    return this.#maps.half_width / this.#zoom;
  }

  get #zoom() {
    const { zoom } = this.#store.state;
    return zoom === 'fit' ? (this.#wide ? 1 : CLOSE) : Number(zoom);
  }

  #left(layer) {
    return layer === 0 ? MARGIN.left : MARGIN.gap;
  }

  #look(layer) {
    const { axes, cloud } = this.#store.state;
    return { axes, zoom: this.#zoom, cloud: cloud === 'shown', text: colour('muted'), withY: layer === 0, hover: this.#hover };
  }

  #drawn({ name, cells, borders, shade, table }, layer) {
    return { name, cells, borders, shade, table, layer, maps: this.#maps, trace: this.#trace };
  }

  #drawLayer(figure, layer) {
    const { canvas, name } = figure;
    const [side, left, ratio] = [this.#side, this.#left(layer), devicePixelRatio];
    const [width, height] = [left + side + MARGIN.right, MARGIN.top + side + MARGIN.bottom];
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
      [canvas.style.width, canvas.style.height] = [`${width}px`, `${height}px`];
      figure.caption.parentElement.style.width = `${width}px`;
    }
    const pen = canvas.getContext('2d');
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.translate(left, MARGIN.top);
    drawMap(pen, this.#drawn(figure, layer), side, this.#look(layer));
    const said = this.#numbers(layer);
    canvas.setAttribute('aria-label', `${name}: ${this.#title()}; ${said.whole}. Arrow keys read values.`);
    const lines = this.#hover ? this.#values(layer) : said.lines;
    figure.lines.forEach((line, i) => (line.textContent = lines[i] ?? ''));
    figure.caption.title = said.whole;
  }

  #showBar({ bar, shade, table }) {
    const [first, colours, last] = bar.children;
    [first.textContent, last.textContent] = ends(shade, digits(shade));
    colours.style.background = gradient(table);
    const [from, to] = ends(shade, 2);
    bar.title = `Colour: ${this.#title()}, from ${from} to ${to}`;
  }

  /** A layer's numbers: lines that fit beneath its map, and a whole one. */
  #numbers(layer) {
    const { peak, log_max, numbers } = this.#maps;
    const at = this.#place(peak[layer]);
    const area = [numbers.area50[layer], numbers.area95[layer]].map((m2) => short(1e4 * m2));
    const entropy = fixed(numbers.entropy[layer] + Math.log(1e4), 2);
    const long = numbers.elongation[layer] >= ROUND;
    const off = fixed(degrees(numbers.off_line[layer]), 0);
    const axis = !long ? 'no ridge' : numbers.off_line[layer] === null ? `axis ${fixed(degrees(numbers.axis[layer]), 0)}°` : `ridge ${off}° off hand`;
    const ratio = `${fixed(numbers.elongation[layer], 1)} times as long as wide`;
    return {
      lines: [`peak ${at} cm`, `50 % ${area[0]}, 95 % ${area[1]} cm²`, `${axis} · entropy ${entropy}`],
      whole:
        `peak at ${at} cm, ln likelihood there ${fixed(log_max[layer], 2)}, at the truth ${fixed(numbers.truth[layer], 2)} of that; ` +
        `50 % of the likelihood in ${area[0]} cm², 95 % in ${area[1]} cm²; entropy ${entropy} nats of a density per cm²; ` +
        `${ratio}${long && numbers.off_line[layer] !== null ? `, the long axis ${off}° off the line from the truth to the hand` : ''}`,
    };
  }

  /** How the modalities differ, pair by pair. */
  #showPairs() {
    const { layers, numbers } = this.#maps;
    const pairs = [];
    for (let i = 0; i < layers.length - 1; i++) {
      for (let j = i + 1; j < layers.length - 1; j++) {
        const [there, back] = [numbers.divergence[i][j], numbers.divergence[j][i]].map((nats) => short(nats));
        pairs.push(`${layers[i]} to ${layers[j]}: KL ${there}, back ${back} nats, overlap ${percent(numbers.overlap[i][j])}`);
      }
    }
    const line = this.#panel.querySelector('#maps-pairs');
    line.textContent = line.title = pairs.join(' · ');
  }

  /** What is at the probe: a line beneath the map. */
  #values(layer) {
    const cell = cellAt(this.#maps, this.#hover);
    const { log, relative, deep } = valueAt(this.#maps, layer, cell);
    const gain = this.#base ? [`gain ${signed(this.#figures[layer].shade.values[cell], 2)} nats`] : [];
    return [`${fixed(relative, 3)} of peak, ln ${deep ? '< ' : ''}${fixed(log, 2)}`, ...gain];
  }

  /** A place in cm, as the axes have it. @param {number[]} offset m */
  #place(offset) {
    const world = this.#store.state.axes === 'world';
    return offset.map((d, i) => (world ? fixed(100 * (d + this.#maps.centre[i])) : signed(100 * d))).join(', ');
  }

  #point(event, layer) {
    if (!this.#maps) return;
    const half = this.#half;
    const x = (event.offsetX - this.#left(layer)) / this.#side;
    const y = (event.offsetY - MARGIN.top) / this.#side;
    this.#probe(x >= 0 && x <= 1 && y >= 0 && y <= 1 ? [(2 * x - 1) * half, (1 - 2 * y) * half] : null);
  }

  /** Arrow keys move the probe cell by cell, and what it finds is read out. */
  #walk(event) {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (event.key === 'Escape') this.#probe(null);
    if (!way || !this.#maps) return;
    event.preventDefault();
    const { half_width: whole, size } = this.#maps;
    const cell = (2 * whole) / size;
    const edge = this.#half - cell / 2;
    const from = this.#hover ?? [0, 0];
    this.#probe(way.map((d, i) => Math.min(Math.max(from[i] + (event.shiftKey ? 5 : 1) * cell * d, -edge), edge)));
    const found = this.#figures.map(({ name }, layer) => `${spoken(name)} ${this.#values(layer).join(', ')}`);
    this.#panel.querySelector('#maps-spoken').textContent = `${this.#place(this.#hover)} cm: ${found.join('; ')}`;
  }

  #probe(offset) {
    if (offset === this.#hover) return;
    this.#hover = offset;
    this.#panel.querySelector('#maps-value').textContent = offset && this.#maps ? `at ${this.#place(offset)} cm` : '';
    this.redraw();
  }
}

const comparable = (a, b) => a.layers.join() === b.layers.join() && Math.abs(a.half_width - b.half_width) < 1e-6;

/** Whether peaks and 95 % regions, taken for ellipses about them, lie in the middle that is shown close. */
function fits({ half_width, peak, numbers }) {
  const most = half_width / CLOSE;
  return peak.every((at, layer) => {
    const radius = Math.sqrt((numbers.area95[layer] / Math.PI) * numbers.elongation[layer]);
    return Math.max(...at.map(Math.abs)) + radius <= most;
  });
}

/** A moment of the page's task in words of an address. */
function moment({ filter, data, episode, faults }, step, angle) {
  const told = { filter, data, episode, step, ...(faults && { faults }), ...(angle !== null && { angle: angle.toFixed(4) }) };
  return String(new URLSearchParams(told));
}

const degrees = (radians) => (radians === null ? null : (radians * 180) / Math.PI);

/** Few digits: of areas and divergences, whose size says more than their digits. */
const short = (value) => fixed(value, value < 10 ? 1 : 0);
