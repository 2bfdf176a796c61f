/** The time line: charts one above the other with one step axis, one cursor, and the hand that scrubs and zooms. */

import { GUTTER, chart } from './chart.js';
import { Marks } from './marks.js';
import { swatch } from './palette.js';
import { stretches } from './trace.js';
import { shownError, tracks } from './tracks.js';
import { fixed } from './units.js';

const CLOSEST = 8; // steps that the strongest zoom still shows
const NOTE = 26; // px of a line in place of a plot
const LINE = 14; // px of a legend's

export class TimeLine {
  #element;
  #host;
  #store;
  #trace = null;
  #tracks = [];
  #charts = [];
  #window = [0, 1];
  #plot = { left: 0, width: 1 }; // px from the host's left edge
  #edge = 0; // px from the window's
  #hover = null;
  #cursor = mark('cursor');
  #pointer = mark('hover');
  #marks;

  /** @param {HTMLElement} element that takes the hand @param {import('./state.js').Store} store */
  constructor(element, store) {
    [this.#element, this.#store] = [element, store];
    this.#host = element.querySelector('#tracks');
    this.#host.append(this.#cursor, this.#pointer);
    this.#marks = new Marks(element.querySelector('#marks'), store);
    new ResizeObserver(() => this.#build()).observe(element);
    this.#takeHand();
  }

  /** @param {import('./trace.js').Trace} trace */
  show(trace) {
    const same = this.#trace?.steps === trace.steps;
    this.#trace = trace;
    if (!same) this.#window = this.#all;
    this.#marks.set([]);
    this.redraw();
  }

  /** Builds the charts anew: for another trace, other choices, other colours. */
  redraw() {
    if (!this.#trace) return;
    this.#tracks = tracks(this.#trace, this.#store.state);
    this.#build();
  }

  /** Moves the cursor; nothing is drawn again. */
  move(step) {
    if (!this.#trace) return;
    const [from, to] = this.#window;
    if (step < from || step > to) this.#look(step - (to - from) / 4, step + (3 * (to - from)) / 4);
    place(this.#cursor, this.#x(step));
    this.#marks.move(step);
    this.#host.setAttribute('aria-valuenow', String(step));
    this.#host.setAttribute('aria-valuetext', `step ${step}, ${fixed(step * this.#trace.dt)} s`);
    if (this.#hover === null) this.#tell(step);
  }

  /**
   * Marks moments of the trace that is shown, until the next call or the next trace.
   * @param {import('./marks.js').Moment[]} moments none: away with those that are there
   */
  mark(moments) {
    this.#marks.set(moments);
    this.#placeMarks();
    if (this.#trace) this.#marks.move(this.#store.state.step);
  }

  /** Shows the whole episode. */
  whole() {
    this.#look(...this.#all);
  }

  /** The step in view at which the fused error is largest. */
  worst() {
    const error = shownError(this.#trace, this.#store.state);
    const [from, to] = this.#window.map((edge) => Math.min(Math.max(Math.round(edge), 0), error.length - 1));
    let worst = from;
    for (let t = from; t <= to; t++) if (error[t] > error[worst]) worst = t;
    return worst;
  }

  get #all() {
    return [0, Math.max(1, this.#trace.steps - 1)];
  }

  #x(step) {
    const [from, to] = this.#window;
    return this.#plot.left + ((step - from) / (to - from)) * this.#plot.width;
  }

  #step(event) {
    const [from, to] = this.#window;
    return from + ((event.clientX - this.#edge - this.#plot.left) / this.#plot.width) * (to - from);
  }

  #look(from, to) {
    const [first, last] = this.#all;
    const span = Math.min(Math.max(to - from, Math.min(CLOSEST, last)), last - first);
    const start = Math.min(Math.max(from, first), last - span);
    this.#window = [start, start + span];
    for (const plot of this.#charts) plot.setScale('x', { min: start, max: start + span });
    this.#placeMarks();
    this.move(this.#store.state.step);
    document.querySelector('#whole').disabled = span >= last - first;
  }

  #build() {
    for (const plot of this.#charts) plot.destroy();
    this.#charts = [];
    this.#host.querySelectorAll('.track').forEach((row) => row.remove());
    const [height, wide] = [this.#host.clientHeight, this.#host.clientWidth];
    if (!this.#trace || height < 60) return;
    const legendWidth = parseFloat(getComputedStyle(this.#element).getPropertyValue('--legend-width'));
    const left = legendWidth + GUTTER.left;
    this.#plot = { left, width: wide - left - GUTTER.right };
    this.#edge = this.#host.getBoundingClientRect().left;
    const trace = this.#trace;
    const shading = { contact: stretches(trace.contact), black: stretches(trace.black) };
    const heights = shares(this.#tracks, height - GUTTER.axis);
    this.#tracks.forEach((track, i) => {
      const withAxis = i === this.#tracks.length - 1;
      const row = document.createElement('div');
      row.className = 'track';
      row.append(legend(track, trace));
      this.#host.append(row);
      if (track.note) return row.append(note(track.note));
      this.#charts.push(
        chart(row, track, shading, {
          width: wide - legendWidth,
          height: heights[i] + (withAxis ? GUTTER.axis - 4 : 0),
          window: () => this.#window,
          steps: trace.steps,
          withAxis,
          stepName: `step (${fixed(trace.dt, 2)} s each)`,
        }),
      );
    });
    this.#host.setAttribute('aria-valuemax', String(trace.steps - 1));
    this.#placeMarks();
    this.move(this.#store.state.step);
  }

  #placeMarks() {
    const [from, to] = this.#window;
    const { left, width } = this.#plot;
    const before = left - GUTTER.left; // the marks are beside the legends
    this.#marks.place((step) => (step < from || step > to ? null : this.#x(step) - before), width + GUTTER.left);
  }

  /** Writes the values at a step into the legends. */
  #tell(step) {
    const { dt } = this.#trace;
    this.#element.querySelector('#told').textContent = `${this.#hover === null ? 'cursor' : 'pointer'} ${step} · ${fixed(step * dt)} s`;
    const rows = this.#host.querySelectorAll('.track');
    this.#tracks.forEach((track, i) => {
      const cells = rows[i]?.querySelectorAll('dd') ?? [];
      track.series.forEach((series, s) => cells[s] && (cells[s].textContent = fixed(series.values[step], track.digits)));
    });
  }

  #takeHand() {
    const element = this.#element;
    const scrub = (event) => {
      const step = Math.min(Math.max(Math.round(this.#step(event)), 0), this.#trace.steps - 1);
      this.#store.set({ step }, { inputTime: event.timeStamp });
    };
    element.addEventListener('pointerdown', (event) => {
      if (!this.#trace || event.button !== 0) return;
      element.setPointerCapture(event.pointerId);
      scrub(event);
    });
    element.addEventListener('pointermove', (event) => {
      if (!this.#trace) return;
      if (element.hasPointerCapture(event.pointerId)) scrub(event);
      this.#pointAt(event);
    });
    element.addEventListener('pointerleave', () => this.#pointAt(null));
    element.addEventListener('dblclick', () => this.#trace && this.whole());
    element.addEventListener('wheel', (event) => this.#turn(event), { passive: false });
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
      const middle = Math.min(Math.max(this.#step(event), from), to);
      const factor = Math.exp(event.deltaY / 500);
      this.#look(middle - (middle - from) * factor, middle + (to - middle) * factor);
    }
  }

  #pointAt(event) {
    const step = event && Math.round(this.#step(event));
    this.#hover = step !== null && step >= this.#window[0] && step <= this.#window[1] ? step : null;
    this.#pointer.hidden = this.#hover === null;
    if (this.#hover !== null) place(this.#pointer, this.#x(this.#hover));
    if (this.#trace) this.#tell(this.#hover ?? this.#store.state.step);
  }
}

function mark(kind) {
  const element = document.createElement('div');
  element.className = `mark ${kind}`;
  element.hidden = kind === 'hover';
  return element;
}

/** px for each track: what its legend needs, and an even share of what is left. */
function shares(tracks, height) {
  const needed = tracks.map(({ note, series }) => (note ? NOTE : 3 + LINE * (1 + series.length)));
  const spare = (height - needed.reduce((a, b) => a + b, 0)) / tracks.filter((track) => !track.note).length;
  return tracks.map(({ note }, i) => Math.floor(needed[i] + (note ? 0 : spare)));
}

const place = (element, x) => (element.style.transform = `translateX(${x.toFixed(2)}px)`);

function note(text) {
  const element = document.createElement('p');
  [element.className, element.style.height, element.textContent] = ['why', `${NOTE}px`, text];
  return element;
}

function legend(track, trace) {
  const element = document.createElement('div');
  element.className = 'legend';
  const title = document.createElement('h3');
  title.textContent = track.unit ? `${track.title} (${track.unit})` : track.title;
  const list = document.createElement('dl');
  for (const { name } of track.series) {
    const term = document.createElement('dt');
    term.append(swatch(name), trace.called(name));
    list.append(term, document.createElement('dd'));
  }
  element.append(title, list);
  return element;
}
