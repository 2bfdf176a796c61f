/** The time line: charts one above the other with one step axis, one cursor, and the hand that scrubs and zooms. */

import { GUTTER, chart, plotted, style } from './chart.js';
import { Marks } from './moment_marks.js';
import { em, sample, variable } from '../core/palette.js';
import { stretches } from '../data/trace.js';
import { KINDS, shownError, tracks } from './tracks.js';
import { fixed, significant } from '../core/units.js';

const CLOSEST = 8; // steps that the strongest zoom still shows
const NOTE = em(26); // px of a line in place of a plot
const LINE = em(14); // px of a legend's
const MEANT = 4; // px from which a drag is one

export class TimeLine {
  #element;
  #host;
  #store;
  #kind;
  #trace = null;
  #other = null;
  #otherName = '';
  #tracks = [];
  #shading = {}; // stretches of steps
  /** @type {{plot: uPlot, track: import('./chart.js').Track, top: number, height: number}[]} px in the host */
  #charts = [];
  /** @type {{text: Text, track: import('./chart.js').Track, place: number}[]} the values in the legends: of which of a track's lines */
  #cells = [];
  #window = [0, 1]; // steps
  #plot = { left: 0, width: 1 }; // px in the host
  #corner = { left: 0, top: 0 }; // px of the host's in the browser's window
  #at = 0; // the cursor's step
  #hover = null;
  #drag = null;
  #fingers = new Map(); // pointer -> {clientX, step} of a finger, and the step that two of them hold
  #cursor = mark('cursor');
  #pointer = mark('hover');
  #level = mark('level');
  #stretch = mark('stretch');
  #marks;
  #told;

  /** @param {HTMLElement} element that takes the hand @param {import('../core/state.js').Store} store */
  constructor(element, store) {
    [this.#element, this.#store] = [element, store];
    [this.#host, this.#told] = ['#tracks', '#told'].map((part) => element.querySelector(part));
    this.#level.append(document.createElement('span'));
    this.#host.append(this.#cursor, this.#pointer, this.#level, this.#stretch);
    this.#marks = new Marks(element.querySelector('#marks'), store);
    this.#kind = document.querySelector('#track');
    this.#kind.replaceChildren(...Object.entries(KINDS).map(([kind, name]) => new Option(name, kind)));
    this.#kind.addEventListener('change', () => store.set({ track: this.#kind.value }));
    store.listen(({ window }, changed) => {
      if (this.#trace && changed.has('window') && window !== this.#written) this.#look(...this.#read(window));
    });
    new ResizeObserver(() => this.#build()).observe(element);
    this.#takeHand();
  }

  /** @param {import('../data/trace.js').Trace} trace */
  show(trace) {
    const { step, window } = this.#store.state;
    const same = (this.#trace?.steps ?? trace.steps) === trace.steps;
    this.#at = this.#trace ? -1 : step; // a link may look elsewhere than at its cursor; later it is to be seen
    this.#trace = trace;
    this.#window = this.#possible(same ? this.#read(window) : this.#all);
    this.#marks.set([]);
    this.redraw();
    this.#look(...this.#window);
  }

  /** Builds the charts anew: for another trace, other choices, other colours. */
  redraw() {
    if (!this.#trace) return;
    const { state } = this.#store;
    this.#tracks = tracks(this.#trace, state, this.#compared);
    [this.#kind.value, this.#kind.disabled] = [state.track, false];
    const key = document.querySelector('#against-key');
    [key.hidden, key.title, key.lastChild.textContent] = [!this.#compared, this.#otherName, this.#otherName];
    document.querySelector('#timeline').classList.toggle('compared', Boolean(this.#compared));
    this.#build();
  }

  /** More steps have come to the trace that is shown: charts stay and get longer. */
  grow() {
    if (!this.#trace) return;
    const longer = tracks(this.#trace, this.#store.state, this.#compared);
    if (!this.#store.state.window) this.#window = this.#all;
    if (!this.#charts.length || alike(longer) !== alike(this.#tracks)) return this.redraw();
    this.#tracks.forEach((track, i) => Object.assign(track, longer[i]));
    this.#shade();
    for (const { plot, track } of this.#charts) plot.setData(plotted(track, this.#trace.steps));
    this.#host.setAttribute('aria-valuemax', String(this.#trace.steps - 1));
    this.#placeMarks();
    this.move(this.#store.state.step);
    this.#tell(this.#hover ?? this.#store.state.step);
  }

  /** Moves the cursor; nothing is drawn again. */
  move(step) {
    if (!this.#trace) return;
    const [from, to] = this.#window;
    const moved = step !== this.#at; // else it may be out of sight
    this.#at = step;
    if (moved && this.#hover !== null && !this.#store.state.playing) this.#pointAt(null); // who moves the cursor wants its values
    if (moved && (step < from || step > to)) return this.#look(step - (to - from) / 4, step + (3 * (to - from)) / 4);
    this.#cursor.hidden = step < from || step > to;
    place(this.#cursor, this.#x(step));
    this.#marks.move(step);
    this.#host.setAttribute('aria-valuenow', String(step));
    this.#host.setAttribute('aria-valuetext', this.#spoken(step));
    if (this.#hover === null) this.#tell(step);
  }

  /**
   * Marks moments of the trace that is shown, until the next call or the next trace.
   * @param {import('./moment_marks.js').Moment[]} moments none: away with those that are there
   */
  mark(moments) {
    this.#marks.set(moments);
    this.#placeMarks();
    if (this.#trace) this.#marks.move(this.#store.state.step);
  }

  /**
   * Draws another trace over the one that is shown, dashed, as long as that is of the same episode.
   * @param {import('../data/trace.js').Trace | null} trace null: away with it @param {string} [name] what it is called
   */
  against(trace, name = '') {
    [this.#other, this.#otherName] = [trace, name];
    this.redraw();
  }

  /** Shows the whole episode. */
  whole() {
    if (this.#trace) this.#look(...this.#all);
  }

  /** Shows more steps or fewer, the cursor staying where it is. @param {number} factor of the steps in view */
  zoom(factor) {
    if (this.#trace) this.#zoomAt(this.#store.state.step, factor);
  }

  /** A tenth of the steps in view. */
  get tenth() {
    return Math.max(1, Math.round((this.#window[1] - this.#window[0]) / 10));
  }

  /** The step in view at which the fused error is largest. */
  worst() {
    const error = shownError(this.#trace, this.#store.state);
    const [from, to] = this.#window.map((edge) => Math.min(Math.max(Math.round(edge), 0), error.length - 1));
    let worst = from;
    for (let t = from; t <= to; t++) if (error[t] > error[worst]) worst = t;
    return worst;
  }

  get #compared() {
    return this.#other?.alongside(this.#trace) ? this.#other : null;
  }

  /** Those of a live run that are still to come have their place, where it is known how many there will be. */
  get #all() {
    const { steps, live } = this.#trace;
    return [0, Math.max(1, steps - 1, live?.state === 'running' ? (live.expected ?? 0) - 1 : 0)];
  }

  /** The window as the state has it: empty for the whole episode. */
  get #written() {
    const [[from, to], [first, last]] = [this.#window, this.#all];
    return to - from >= last - first ? '' : `${shorter(from)}-${shorter(to)}`;
  }

  #read(window) {
    return window ? window.split('-').map(Number) : this.#all;
  }

  #x(step) {
    const [from, to] = this.#window;
    return this.#plot.left + ((step - from) / (to - from)) * this.#plot.width;
  }

  #step(event) {
    const [from, to] = this.#window;
    return from + ((event.clientX - this.#corner.left - this.#plot.left) / this.#plot.width) * (to - from);
  }

  #nearest(event) {
    return Math.min(Math.max(Math.round(this.#step(event)), 0), this.#trace.steps - 1);
  }

  /** As many steps as are asked for where that can be, and only such as there are. */
  #possible([from, to]) {
    const [first, last] = this.#all;
    const span = Math.min(Math.max(to - from, Math.min(CLOSEST, last)), last - first);
    const start = Math.min(Math.max(from, first), last - span);
    return [start, start + span];
  }

  /** Brings steps into view. */
  #look(from, to) {
    if (!this.#trace) return;
    this.#window = this.#possible([from, to]);
    const window = this.#written;
    this.#store.set({ window });
    const [min, max] = this.#window;
    for (const { plot } of this.#charts) plot.setScale('x', { min, max });
    this.#placeMarks();
    this.move(this.#store.state.step);
    document.querySelector('#whole').disabled = !window;
  }

  #zoomAt(step, factor) {
    const [from, to] = this.#window;
    const middle = Math.min(Math.max(step, from), to);
    this.#look(middle - (middle - from) * factor, middle + (to - middle) * factor);
  }

  #build() {
    for (const { plot } of this.#charts) plot.destroy();
    [this.#charts, this.#cells] = [[], []];
    this.#host.querySelectorAll('.track').forEach((row) => row.remove());
    const [height, wide] = [this.#host.clientHeight, this.#host.clientWidth];
    if (!this.#trace || height < 60) return;
    const trace = this.#trace;
    const legendWidth = parseFloat(getComputedStyle(this.#element).getPropertyValue('--legend-width'));
    const left = legendWidth + GUTTER.left;
    this.#plot = { left, width: wide - left - GUTTER.right };
    this.#measure();
    this.#shade();
    const lowest = this.#tracks.length - 1;
    const heights = shares(this.#tracks, height - GUTTER.axis);
    this.#tracks.forEach((track, i) => {
      const row = document.createElement('div');
      row.className = 'track';
      row.append(this.#legend(track));
      this.#host.append(row);
      if (track.note) row.append(note(track.note, heights[i]));
      if (track.note && i < lowest) return;
      const frame = {
        width: wide - legendWidth,
        height: heights[i] + (i === lowest ? GUTTER.axis - 4 : 0),
        window: () => this.#window,
        steps: trace.steps,
        withAxis: i === lowest,
        stepName: `step (${fixed(trace.dt, 2)} s each)`,
        compared: Boolean(this.#compared),
      };
      this.#charts.push({ plot: chart(row, track, this.#shading, frame), track, top: row.offsetTop, height: heights[i] });
    });
    this.#host.setAttribute('aria-valuemax', String(trace.steps - 1));
    this.#placeMarks();
    this.move(this.#store.state.step);
    this.#tell(this.#hover ?? this.#store.state.step);
  }

  /** Names, lines and values of a track; what is cut short is said in full under the pointer. */
  #legend(track) {
    const { title, unit, help, series } = track;
    const element = document.createElement('div');
    element.className = 'legend';
    const heading = document.createElement('h3');
    heading.textContent = unit ? `${title} (${unit})` : title;
    heading.title = help ?? heading.textContent;
    const list = document.createElement('dl');
    for (const name of new Set(series.map((s) => s.name))) {
      const term = document.createElement('dt');
      const own = series.find((s) => s.name === name);
      const { dash, width } = style(own, this.#compared);
      term.append(sample(variable(name), dash, width), this.#trace.called(name));
      term.title = term.textContent;
      list.append(term);
      for (const other of this.#compared ? [false, true] : [false]) {
        const cell = document.createElement('dd');
        const place = series.findIndex((s) => s.name === name && Boolean(s.other) === other);
        const text = cell.appendChild(new Text());
        if (place >= 0) this.#cells.push({ text, track, place });
        list.append(cell);
      }
    }
    element.append(heading, list);
    return element;
  }

  /** The charts keep hold of the one object. */
  #shade() {
    Object.assign(this.#shading, { contact: stretches(this.#trace.contact), black: stretches(this.#trace.black), edit: this.#compared?.edited });
  }

  #measure() {
    const { left, top } = this.#host.getBoundingClientRect();
    this.#corner = { left, top };
  }

  #placeMarks() {
    const [from, to] = this.#window;
    const { left, width } = this.#plot;
    const before = left - GUTTER.left; // the marks are beside the legends
    this.#marks.place((step) => (step < from || step > to ? null : this.#x(step) - before), width + GUTTER.left);
  }

  /** Writes the values at a step into the legends. */
  #tell(step) {
    this.#told.textContent = `${this.#hover === null ? 'cursor' : 'pointer'} ${step} · ${fixed(step * this.#trace.dt)} s`;
    for (const { text, track: { series, digits }, place } of this.#cells) {
      const { values } = series[place];
      const value = digits === undefined ? significant(values[step]) : fixed(values[step], digits);
      if (text.data !== value) text.data = value;
    }
  }

  /** A step as it is read out. */
  #spoken(step) {
    const trace = this.#trace;
    const parts = [`step ${step}`, `${fixed(step * trace.dt)} s`, `${fixed(trace.error('fused', 'position')[step])} cm off`];
    if (!trace.knows(step)) parts.pop();
    if (trace.contact[step]) parts.push('in contact');
    if (trace.black[step]) parts.push('black picture');
    return parts.join(', ');
  }

  #takeHand() {
    const element = this.#element;
    element.addEventListener('pointerenter', () => this.#measure());
    element.addEventListener('pointerdown', (event) => {
      if (!this.#trace || event.button > 1) return;
      const kind = event.button === 1 ? 'pan' : event.shiftKey ? 'zoom' : 'scrub';
      this.#drag = { kind, x: event.clientX, step: this.#step(event), window: this.#window };
      if (event.pointerType === 'touch') this.#fingers.set(event.pointerId, { clientX: event.clientX });
      if (this.#fingers.size === 2) {
        this.#drag.kind = 'pinch';
        for (const finger of this.#fingers.values()) finger.step = this.#step(finger);
      }
      element.setPointerCapture(event.pointerId);
      this.#pointAt(null);
      this.#pull(event);
    });
    element.addEventListener('mousedown', (event) => event.button === 1 && event.preventDefault()); // the browser's own scrolling
    element.addEventListener('pointermove', (event) => this.#trace && (this.#drag ? this.#pull(event) : this.#pointAt(event)));
    element.addEventListener('pointerup', (event) => this.#release(event));
    element.addEventListener('pointercancel', () => (this.#fingers.clear(), this.#release(null)));
    element.addEventListener('pointerleave', () => this.#pointAt(null));
    element.addEventListener('dblclick', () => this.whole());
    element.addEventListener('wheel', (event) => this.#turn(event), { passive: false });
  }

  /** The hand moves while it holds something. */
  #pull(event) {
    const { kind, x, step, window } = this.#drag;
    if (this.#fingers.has(event.pointerId)) this.#fingers.get(event.pointerId).clientX = event.clientX;
    if (kind === 'pinch') return this.#pinch();
    if (kind === 'scrub') return this.#store.set({ step: this.#nearest(event) }, { inputTime: event.timeStamp });
    if (kind === 'pan') {
      const shift = ((x - event.clientX) / this.#plot.width) * (window[1] - window[0]);
      return this.#look(window[0] + shift, window[1] + shift);
    }
    const [left, right] = [step, this.#step(event)].sort((a, b) => a - b).map((edge) => this.#x(Math.min(Math.max(edge, this.#window[0]), this.#window[1])));
    this.#stretch.hidden = false;
    this.#stretch.style.width = `${right - left}px`;
    place(this.#stretch, left);
  }

  /** Each of two fingers keeps the step that it took hold of. */
  #pinch() {
    const [one, other] = [...this.#fingers.values()].sort((a, b) => a.step - b.step);
    if (!other || other.clientX - one.clientX < MEANT) return;
    const scale = (other.step - one.step) / (other.clientX - one.clientX); // steps a px
    const from = one.step - scale * (one.clientX - this.#corner.left - this.#plot.left);
    this.#look(from, from + scale * this.#plot.width);
  }

  #release(event) {
    if (event) this.#fingers.delete(event.pointerId);
    const drag = this.#drag;
    this.#drag = null;
    this.#stretch.hidden = true;
    if (!event || drag?.kind !== 'zoom' || Math.abs(event.clientX - drag.x) < MEANT) return;
    this.#look(...[drag.step, this.#step(event)].sort((a, b) => a - b));
  }

  #turn(event) {
    if (!this.#trace) return;
    event.preventDefault();
    const [from, to] = this.#window;
    const sideways = event.shiftKey && !event.deltaX ? event.deltaY : event.deltaX;
    if (Math.abs(sideways) > Math.abs(event.shiftKey ? 0 : event.deltaY)) {
      const shift = ((to - from) * sideways) / 1000;
      this.#look(from + shift, to + shift);
    } else {
      this.#zoomAt(this.#step(event), Math.exp(event.deltaY / 500));
    }
  }

  /** The crosshair, and the values under it in place of the cursor's. */
  #pointAt(event) {
    if (!this.#trace) return;
    const step = event && Math.round(this.#step(event));
    this.#hover = step !== null && step >= this.#window[0] && step <= this.#window[1] ? step : null;
    const y = event ? event.clientY - this.#corner.top : -1;
    const under = this.#hover !== null && this.#charts.find(({ track, top, height }) => !track.note && y > top && y < top + height);
    [this.#pointer.hidden, this.#level.hidden] = [this.#hover === null, !under];
    if (this.#hover !== null) place(this.#pointer, this.#x(this.#hover));
    if (under) {
      const value = under.plot.posToVal(y - under.top - under.plot.bbox.top / devicePixelRatio, 'y');
      const { digits } = under.track;
      this.#level.style.transform = `translateY(${y.toFixed(1)}px)`;
      this.#level.firstChild.textContent = digits === undefined ? significant(value) : fixed(value, digits);
    }
    this.#tell(this.#hover ?? this.#store.state.step);
  }
}

/** What must be the same of tracks for their charts to stay. */
const alike = (tracks) => JSON.stringify(tracks.map(({ title, note, unit, series }) => [title, note, unit, series.map(({ name, sigma, other }) => [name, Boolean(sigma), other])]));

const shorter = (step) => String(Number(step.toFixed(1)));

function mark(kind) {
  const element = document.createElement('div');
  [element.className, element.hidden] = [`mark ${kind}`, true];
  return element;
}

/** px for each track: what its legend needs, and an even share of what is left. The lowest is always a chart, for its axis. */
function shares(tracks, height) {
  const plain = ({ note }, i) => note && i < tracks.length - 1;
  const needed = tracks.map((track, i) => (plain(track, i) ? NOTE : 3 + LINE * (1 + Math.max(new Set(track.series.map((s) => s.name)).size, 2))));
  const spare = (height - needed.reduce((a, b) => a + b, 0)) / tracks.filter((track, i) => !plain(track, i)).length;
  return tracks.map((track, i) => Math.floor(needed[i] + (plain(track, i) ? 0 : spare)));
}

const place = (element, x) => (element.style.transform = `translateX(${x.toFixed(2)}px)`);

function note(text, height) {
  const element = document.createElement('p');
  [element.className, element.style.height, element.textContent] = ['why', `${height}px`, text];
  return element;
}
