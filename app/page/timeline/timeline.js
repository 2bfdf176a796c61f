/** The timeline: charts with a common step axis and cursor. */

/** @import { Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { SmallestRepair } from '../types/server.js' */
/** @import { Shading, Track } from './chart.js' */
/** @import { EventMark } from './event_marks.js' */
/** @import { ValueCell } from './legend.js' */
/** @import { StepAxis } from './step_axis.js' */
/** @import { StepWindow } from './step_window.js' */

import { create, element, html, setOptions } from '../core/dom.js';
import { fixed, withUnit } from '../core/units.js';
import { intervals } from '../data/arrays.js';
import { GUTTER, chart } from './chart.js';
import { chartData } from './chart_data.js';
import { ChartMenu } from './chart_menu.js';
import { EventMarks } from './event_marks.js';
import { Gestures } from './gestures.js';
import { GroupPicker } from './group_picker.js';
import { HoverValues } from './hover_values.js';
import { isCompact, isDense, layoutKey, noteElement, trackHeights } from './layout.js';
import { formatValue, legend, legendWidth, updateLegend } from './legend.js';
import { Overview } from './overview.js';
import { standalonePicker } from './standalone_picker.js';
import { STEPS, secondsAxis } from './step_axis.js';
import { fitWindow, formatWindow, parseWindow, zoomWindow } from './step_window.js';
import { TrackSizes } from './track_sizes.js';
import { selectedError, trackOptions, tracks } from './tracks.js';

const MIN_HEIGHT = 60; // px, below which there are no charts
const CURSOR_MARGIN = 0.25; // share of the visible steps before the cursor when it comes into view

/** @typedef {{plot: uPlot, track: Track, top: number, height: number}} Chart top and height in px of the host */

/** @param {string} kind */
const overlayMark = (kind) => create('div', { className: `mark ${kind}`, hidden: true });

export class Timeline {
  #host;
  #store;
  #trackSelect;
  /** @type {Trace | null} */
  #trace = null;
  /** @type {Trace | null} */
  #comparison = null;
  #comparisonName = '';
  /** @type {Track[]} */
  #tracks = [];
  /** @type {Shading} */
  #shading = { contact: [], blackout: [], interventions: [] };
  /** @type {Chart[]} */
  #charts = [];
  /** @type {ValueCell[]} */
  #cells = [];
  /** @type {StepWindow} */
  #window = [0, 1];
  #plot = { left: 0, width: 1 }; // px in the host
  #origin = { left: 0, top: 0 }; // px of the host in the browser window
  /** @type {StepAxis} */
  #axis = STEPS;
  #step = 0;
  /** Step below the pointer. @type {number | null} */
  #hover = null;
  #cursor = overlayMark('cursor');
  #pointer = overlayMark('hover');
  #levelText = create('span');
  #level = overlayMark('level');
  #selection = overlayMark('selection');
  #stepLabel = create('p', { className: 'step-label' });
  #marks;
  #overview;
  #values;
  #showStandalone;
  #group;
  #menu;
  #sizes = new TrackSizes(() => this.#build());
  #readout;
  #resetButton = element('#reset-zoom', HTMLButtonElement);
  #legendWidth = 0;

  /**
   * @param {HTMLElement} body
   * @param {Store} store
   */
  constructor(body, store) {
    this.#store = store;
    this.#host = html('#tracks', body);
    this.#readout = html('#timeline-readout', body);
    this.#level.append(this.#levelText);
    this.#host.append(this.#stepLabel, this.#cursor, this.#pointer, this.#level, this.#selection);
    this.#values = new HoverValues(this.#host);
    this.#marks = new EventMarks(html('#marks', body), store);
    this.#overview = new Overview(html('#overview', body), this.#marks, {
      all: () => this.#allSteps,
      axis: () => this.#axis,
      window: () => this.#window,
      setWindow: (window) => this.#setWindow(window),
      scrub: (step, inputTime) => store.set({ step: this.#nearest(step) }, { inputTime }),
    });
    this.#showStandalone = standalonePicker(store);
    this.#group = new GroupPicker(() => this.redraw());
    this.#menu = new ChartMenu(html('#chart-menu'), html('#charts'), store, () =>
      this.#sizes.reset(),
    );
    this.#trackSelect = element('#track', HTMLSelectElement);
    this.#trackSelect.addEventListener('change', () =>
      store.set({ track: this.#trackSelect.value }),
    );
    store.when(['window'], ({ window }) => {
      if (this.#trace && window !== this.#windowText)
        this.#setWindow(parseWindow(window, this.#allSteps));
    });
    new ResizeObserver(() => this.#build()).observe(body);
    new Gestures(body, {
      isReady: () => this.#trace !== null,
      measure: () => this.#measure(),
      stepAt: (clientX) => this.#stepAt(clientX),
      stepsPerPixel: () => (this.#window[1] - this.#window[0]) / this.#plot.width,
      window: () => this.#window,
      setWindow: (window) => this.#setWindow(window),
      scrub: (step, inputTime) => store.set({ step: this.#nearest(step) }, { inputTime }),
      zoom: (step, factor) => this.#setWindow(zoomWindow(this.#window, step, factor)),
      reset: () => this.showAll(),
      hover: (event) => this.#pointAt(event),
      select: (selection) => this.#showSelection(selection),
    });
  }

  /** @param {Trace} trace */
  show(trace) {
    const { step, window } = this.#store.state;
    const sameLength = !this.#trace || this.#trace.steps === trace.steps;
    this.#step = this.#trace ? -1 : step; // only the first trace may show other steps than the cursor's
    this.#trace = trace;
    const all = this.#allSteps;
    this.#window = fitWindow(sameLength ? parseWindow(window, all) : all, all);
    this.mark([]);
    this.showRepair(null);
    this.#showStandalone(trace);
    this.#group.show(trace.groups);
    this.#menu.show(trace);
    this.redraw();
    this.#setWindow(this.#window);
  }

  /** Rebuilds the charts. */
  redraw() {
    if (!this.#trace) return;
    const { state } = this.#store;
    const comparison = this.#activeComparison;
    this.#axis = state.time === 'seconds' ? secondsAxis(this.#trace) : STEPS;
    const { stepText } = this.#trace;
    this.#stepLabel.textContent = this.#axis.inSeconds
      ? `time in s, ${stepText} steps`
      : `step, ${stepText} each`;
    this.#tracks = tracks(this.#trace, state, comparison);
    const options = trackOptions(this.#trace, state.track);
    setOptions(this.#trackSelect, options, state.track);
    this.#showComparison();
    this.#build();
  }

  /** Adds the new steps of a live run to the charts. */
  grow() {
    const trace = this.#trace;
    if (!trace) return;
    const grown = tracks(trace, this.#store.state, this.#activeComparison);
    if (!this.#store.state.window) this.#window = this.#allSteps;
    if (!this.#charts.length || layoutKey(grown) !== layoutKey(this.#tracks)) {
      this.redraw();
      return;
    }
    this.#tracks.forEach((track, i) => Object.assign(track, grown[i]));
    this.#updateShading();
    for (const { plot, track } of this.#charts)
      plot.setData(chartData(track, trace.steps, this.#axis));
    this.#updateCursor();
  }

  /**
   * Moves the cursor without redrawing the charts.
   * @param {number} step
   */
  move(step) {
    if (!this.#trace) return;
    const [from, to] = this.#window;
    const moved = step !== this.#step;
    this.#step = step;
    // The legends show the values at the cursor again.
    if (moved && this.#hover !== null && !this.#store.state.playing) this.#pointAt(null);
    if (moved && (step < from || step > to)) {
      const start = step - CURSOR_MARGIN * (to - from);
      this.#setWindow([start, start + to - from]);
      return;
    }
    this.#cursor.hidden = step < from || step > to;
    place(this.#cursor, this.#x(step));
    this.#marks.move(step);
    this.#overview.move(step);
    this.#host.ariaValueNow = String(step);
    this.#host.ariaValueText = this.#describe(step);
    if (this.#hover === null) this.#showValues(step);
  }

  /**
   * Marks events of the trace until the next call or the next trace, and the restarts of a filter that fails.
   * @param {EventMark[]} events
   */
  mark(events) {
    const restarts = this.#trace?.header.failure?.restarts ?? [];
    const label = 'the filter is restarted at the true state';
    const marks = restarts.map((step) => ({
      step,
      time: this.#trace?.seconds(step) ?? null,
      label,
    }));
    this.#marks.set([...marks, ...events]);
    this.#overview.update();
    if (this.#trace) this.#marks.move(this.#store.state.step);
  }

  /**
   * Underlines a failure of the trace and its repair until the next call or the next trace.
   * @param {Pick<SmallestRepair, 'failure' | 'repair'> | null} result
   */
  showRepair(result) {
    /** @param {number[] | null | undefined} steps @returns {[number, number][]} */
    const asIntervals = (steps) => (steps ? [[steps[0], steps[1]]] : []);
    this.#shading.failure = asIntervals(result?.failure);
    this.#shading.repair = asIntervals(result?.repair?.steps);
    html('#repair-key').hidden = !result?.failure;
    for (const { plot } of this.#charts) plot.redraw();
  }

  /**
   * Draws a comparison run, as thin lines, if it has the same episode.
   * @param {Trace | null} trace
   * @param {string} [name] its name; without a trace, the progress of its computation
   * @returns {boolean} whether the run has changed
   */
  compareWith(trace, name = '') {
    const changed = trace !== this.#comparison;
    [this.#comparison, this.#comparisonName] = [trace, name];
    if (changed) this.redraw();
    else this.#showComparison();
    return changed;
  }

  /** Shows the name of the comparison run, or the progress of its computation. */
  #showComparison() {
    const key = html('#comparison-key');
    const hidden = this.#comparison !== null && !this.#activeComparison; // of another episode
    [key.hidden, key.title] = [hidden || !this.#comparisonName, this.#comparisonName];
    html('span', key).textContent = this.#comparisonName;
    html('#timeline').classList.toggle('compared', Boolean(this.#activeComparison));
  }

  /** Shows the whole episode. */
  showAll() {
    if (this.#trace) this.#setWindow(this.#allSteps);
  }

  /**
   * Zooms around the cursor.
   * @param {number} factor of the number of visible steps
   */
  zoom(factor) {
    if (this.#trace) this.#setWindow(zoomWindow(this.#window, this.#store.state.step, factor));
  }

  /** A tenth of the visible steps. */
  get pageStep() {
    return Math.max(1, Math.round((this.#window[1] - this.#window[0]) / 10));
  }

  /** The visible step with the largest error of the fused estimate, after the warm-up if it is visible. */
  get largestError() {
    const error = this.#trace && selectedError(this.#trace, this.#store.state);
    if (!error) return this.#step;
    const [start, to] = this.#window.map((edge) => this.#nearest(edge));
    const first = this.#trace?.header.first_counted ?? 0;
    const from = first <= to ? Math.max(start, first) : start;
    let result = from;
    for (let t = from; t <= to; t++) if (error[t] > error[result]) result = t;
    return result;
  }

  get #activeComparison() {
    return this.#trace && this.#comparison?.hasSameEpisode(this.#trace) ? this.#comparison : null;
  }

  /** All steps, including the expected ones of a live run. @returns {StepWindow} */
  get #allSteps() {
    const { steps = 0, live } = this.#trace ?? {};
    const expected = live?.state === 'running' ? (live.expected ?? 0) : 0;
    return [0, Math.max(1, steps - 1, expected - 1)];
  }

  get #windowText() {
    return formatWindow(this.#window, this.#allSteps);
  }

  /** @param {number} step */
  #x(step) {
    const [from, to] = this.#window.map(this.#axis.position);
    const share = (this.#axis.position(step) - from) / (to - from);
    return this.#plot.left + share * this.#plot.width;
  }

  /** @param {number} clientX */
  #stepAt(clientX) {
    const [from, to] = this.#window.map(this.#axis.position);
    const share = (clientX - this.#origin.left - this.#plot.left) / this.#plot.width;
    return this.#axis.step(from + share * (to - from));
  }

  /** @param {number} step */
  #nearest(step) {
    return Math.min(Math.max(Math.round(step), 0), (this.#trace?.steps ?? 1) - 1);
  }

  /** @param {StepWindow} window */
  #setWindow(window) {
    if (!this.#trace) return;
    this.#window = fitWindow(window, this.#allSteps);
    const text = this.#windowText;
    this.#store.set({ window: text });
    const [min, max] = this.#window.map(this.#axis.position);
    for (const { plot } of this.#charts) plot.setScale('x', { min, max });
    this.#overview.update();
    this.move(this.#store.state.step);
    this.#resetButton.disabled = !text;
  }

  #build() {
    for (const { plot } of this.#charts) plot.destroy();
    [this.#charts, this.#cells] = [[], []];
    this.#host.querySelectorAll('.track').forEach((row) => row.remove());
    const { clientHeight, clientWidth } = this.#host;
    if (!this.#trace || clientHeight < MIN_HEIGHT) return;
    const compact = isCompact(clientHeight);
    this.#host.classList.toggle('compact', compact);
    const keys = this.#tracks.map(({ key = '' }) => key);
    const heights = this.#sizes.apply(keys, trackHeights(this.#tracks, clientHeight - GUTTER.axis));
    const dense = this.#tracks.some((track, i) => isDense(track, heights[i]));
    const names = legendWidth(
      this.#trace,
      this.#tracks,
      compact ? 'compact' : dense ? 'dense' : 'full',
    );
    html('#timeline').style.setProperty('--legend-names', `${names}rem`);
    const style = getComputedStyle(this.#host);
    this.#legendWidth = parseFloat(style.getPropertyValue('--legend-width'));
    const left = this.#legendWidth + GUTTER.left;
    this.#plot = { left, width: clientWidth - left - GUTTER.right };
    this.#measure();
    this.#updateShading();
    this.#values.show(this.#tracks);
    this.#tracks.forEach((track, i) => {
      const row = this.#buildTrack(track, heights[i], compact);
      if (i + 1 < keys.length) row?.append(this.#sizes.separator(keys, heights, i));
    });
    this.#updateCursor();
  }

  /**
   * @param {Track} track
   * @param {number} height px
   * @param {boolean} compact
   */
  #buildTrack(track, height, compact) {
    const trace = this.#trace;
    if (!trace) return null;
    const compared = Boolean(this.#activeComparison);
    const { element: legendElement, cells } = legend(
      track,
      trace,
      compared,
      compact || isDense(track, height),
    );
    legendElement.classList.toggle('dense', !compact && isDense(track, height));
    this.#cells.push(...cells);
    const row = create('div', { className: 'track' }, legendElement);
    this.#host.append(row);
    const lowest = track === this.#tracks.at(-1);
    row.style.height = `${height}px`;
    if (track.note) row.append(noteElement(track.note, height));
    if (track.note && !lowest) return row;
    const plot = chart(row, track, this.#shading, {
      width: this.#host.clientWidth - this.#legendWidth,
      height: height + (lowest ? GUTTER.axis - 4 : 0),
      window: () => this.#window,
      steps: trace.steps,
      axis: this.#axis,
      withAxis: lowest,
    });
    this.#charts.push({ plot, track, top: row.offsetTop, height });
    return row;
  }

  #updateCursor() {
    this.#host.ariaValueMax = String((this.#trace?.steps ?? 1) - 1);
    if (this.#trace) this.#overview.draw(this.#shading, this.#trace.error('fused', 'main') ?? []);
    this.move(this.#store.state.step);
    this.#showValues(this.#hover ?? this.#store.state.step);
  }

  /** Updates the object that the charts share. */
  #updateShading() {
    if (!this.#trace) return;
    Object.assign(this.#shading, {
      contact: intervals(this.#trace.group(this.#group.value)),
      label: this.#group.value,
      blackout: intervals(this.#trace.blackout),
      faulty: intervals(this.#trace.faulty),
      faultLabel: this.#trace.faultLabel,
      interventions: this.#activeComparison?.interventions ?? [],
    });
  }

  #measure() {
    const { left, top } = this.#host.getBoundingClientRect();
    this.#origin = { left, top };
  }

  /**
   * Shows the values at a step in the legends.
   * @param {number} step
   */
  #showValues(step) {
    if (!this.#trace) return;
    const name = this.#hover === null ? 'cursor' : 'pointer';
    this.#readout.textContent = `${name} ${step} · ${this.#trace.timeText(step)}`;
    updateLegend(this.#cells, step);
  }

  /**
   * Describes a step for screen readers.
   * @param {number} step
   */
  #describe(step) {
    const trace = this.#trace;
    if (!trace) return '';
    const parts = [`step ${step}`, trace.timeText(step)];
    if (trace.hasTruth(step))
      parts.push(`error ${withUnit(fixed(trace.error('fused', 'main')?.[step]), trace.mainUnit)}`);
    const groups = trace.groups.filter((name) => trace.group(name)[step]);
    parts.push(...groups.map((name) => (name === 'contact' ? 'in contact' : name)));
    if (trace.blackout[step]) parts.push('image blacked out');
    if (trace.faulty[step]) parts.push(trace.faultLabel);
    return parts.join(', ');
  }

  /** @param {StepWindow | null} selection */
  #showSelection(selection) {
    this.#selection.hidden = !selection;
    if (!selection) return;
    const [from, to] = this.#window;
    const [left, right] = selection.map((edge) => this.#x(Math.min(Math.max(edge, from), to)));
    this.#selection.style.width = `${right - left}px`;
    place(this.#selection, left);
  }

  /**
   * Shows the crosshair, and the values below it in place of those at the cursor.
   * @param {PointerEvent | null} event
   */
  #pointAt(event) {
    if (!this.#trace) return;
    const [from, to] = this.#window;
    const step = event ? Math.round(this.#stepAt(event.clientX)) : NaN;
    this.#hover = step >= from && step <= to ? step : null;
    const y = event ? event.clientY - this.#origin.top : -1;
    const target = this.#charts.find(
      ({ track, top, height }) => !track.note && y > top && y < top + height,
    );
    this.#pointer.hidden = this.#hover === null;
    this.#level.hidden = this.#hover === null || !target;
    if (this.#hover !== null) place(this.#pointer, this.#x(this.#hover));
    if (this.#hover !== null && target) {
      const { plot, track, top } = target;
      const value = plot.posToVal(y - top - plot.bbox.top / devicePixelRatio, 'y');
      this.#level.style.transform = `translateY(${y.toFixed(1)}px)`;
      this.#levelText.textContent = formatValue(value, track);
    }
    this.#showValues(this.#hover ?? this.#store.state.step);
    if (this.#hover === null || !event || y < 0) return this.#values.hide();
    const { clientWidth: width, clientHeight: height } = this.#host;
    const pointer = { x: event.clientX - this.#origin.left, y, width, height };
    this.#values.move(this.#trace, this.#hover, pointer);
  }
}

/**
 * @param {HTMLElement} target
 * @param {number} x px
 */
function place(target, x) {
  target.style.transform = `translateX(${x.toFixed(2)}px)`;
}
