/** Figures of a diagnostic: curves over the steps with the page's cursor, plots, pixel maps and tables. */

/** @import { Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { Curve, DiagnosticResult, Table } from '../types/server.js' */

import { columnHeading, create, fillTable } from '../core/dom.js';
import { csv } from '../core/download.js';
import { scaled, swatch } from '../core/colours.js';
import { sentence, significant, typeset } from '../core/units.js';
import { intervals } from '../data/arrays.js';
import { GUTTER, shadeBounds, shadeIntervals } from '../timeline/chart.js';
import { LABEL, PLAIN, axisStyle } from '../timeline/plot_style.js';
import { copyButton } from './copy_button.js';
import {
  drawPixelMap,
  drawPlot,
  extent,
  heading,
  label,
  legendEntry,
  lineStyles,
  padded,
} from './plots.js';

/** @typedef {Omit<DiagnosticResult, 'trajectories'>} Views */
/** @typedef {{plot: uPlot, cursor: HTMLElement, values: HTMLElement[], curves: Curve[]}} CurveChart */

const HEIGHT = { chart: scaled(104), axis: scaled(30) }; // px

export class Figures {
  #host;
  #store;
  /** @type {Views | null} */
  #result = null;
  /** @type {Trace | null} */
  #trace = null;
  /** @type {CurveChart[]} */
  #charts = [];
  /** @type {uPlot[]} */
  #plots = [];
  #width = 0;

  /**
   * @param {HTMLElement} host
   * @param {Store} store
   */
  constructor(host, store) {
    this.#host = host;
    this.#store = store;
    const resize = () => this.#host.clientWidth !== this.#width && this.redraw();
    new ResizeObserver(resize).observe(host);
  }

  /**
   * @param {Views | null} result
   * @param {Trace | null} trace the displayed trace; null if the result is not of a single trace
   */
  show(result, trace) {
    if (result === this.#result && trace === this.#trace) return;
    this.#result = result;
    this.#trace = trace;
    this.redraw();
  }

  /** Draws everything again, after a change of results, width or theme. */
  redraw() {
    for (const plot of [...this.#charts.map((chart) => chart.plot), ...this.#plots]) plot.destroy();
    [this.#charts, this.#plots] = [[], []];
    this.#width = this.#host.clientWidth;
    const result = this.#result;
    if (!result) this.#host.replaceChildren();
    if (!result || !this.#width) return;
    const scrollTop = this.#host.parentElement?.scrollTop ?? 0;
    const charts = create('div', { className: 'curves' });
    const panels = create('div', { className: 'panels' });
    this.#host.replaceChildren(charts, panels, ...result.tables.map((t) => this.#table(t)));
    const groups = curvesByChart(result.curves);
    groups.forEach((curves, i) => this.#curveChart(charts, curves, i === groups.length - 1));
    for (const plot of result.plots) this.#plots.push(drawPlot(panels, plot));
    panels.append(...result.images.map(drawPixelMap));
    if (this.#host.parentElement) this.#host.parentElement.scrollTop = scrollTop;
  }

  /**
   * Moves the cursor without drawing the charts again.
   * @param {number} step
   */
  move(step) {
    for (const { plot, cursor, values, curves } of this.#charts) {
      cursor.style.transform = `translateX(${plot.valToPos(step, 'x').toFixed(2)}px)`;
      values.forEach((cell, i) => (cell.textContent = significant(curves[i].values[step])));
    }
  }

  /**
   * @param {HTMLElement} parent
   * @param {Curve[]} curves of one chart
   * @param {boolean} last whether the step axis has labels
   */
  #curveChart(parent, curves, last) {
    const styles = lineStyles(curves);
    const { unit, chart } = curves[0];
    const head = heading(titleWithUnit(chart, unit));
    const values = curves.map(() => document.createElement('b'));
    head.append(...curves.map((curve, i) => legendEntry(styles[i], curve.name, values[i])));
    const canvas = create('div', { className: 'canvas', role: 'img' });
    canvas.ariaLabel = `${chart} over steps: ${curves.map((c) => c.name).join(', ')}`;
    parent.append(create('figure', {}, head, canvas));
    const steps = curves[0].values.length;
    const bounds = curves.map((curve) => curve.bounds).find(Boolean);
    const limits = padded(extent([...curves.flatMap((c) => c.values), ...(bounds ?? [])]));
    const bands = this.#result?.bands ?? {};
    const shading = {
      contact: intervals(bands.contact ?? []),
      blackout: intervals(bands.blackout ?? []),
      interventions: intervals(bands.intervention ?? []),
    };
    const hiddenLabels = {
      ticks: { show: false },
      values: (/** @type {uPlot} */ _, /** @type {number[]} */ splits) => splits.map(() => ''),
    };
    const plot = new uPlot(
      {
        width: this.#width,
        height: HEIGHT.chart + (last ? HEIGHT.axis - 4 : 0),
        padding: [4, GUTTER.right, last ? 0 : 4, 0],
        ...PLAIN,
        scales: {
          x: { time: false, range: () => [0, Math.max(1, steps - 1)] },
          y: { range: () => limits },
        },
        axes: [
          {
            ...axisStyle(),
            gap: 2,
            space: scaled(60),
            size: last ? HEIGHT.axis - LABEL.labelSize : 0,
            ...(last ? { label: 'step', ...LABEL } : hiddenLabels),
          },
          { ...axisStyle(), size: GUTTER.left, gap: 3, space: scaled(20) },
        ],
        series: [
          {},
          ...styles.map(({ stroke, dash, width }, i) => ({
            stroke,
            dash,
            width,
            points: isolatedPoints(curves[i].values, stroke),
          })),
        ],
        hooks: {
          ready: [() => this.move(this.#store.state.step)],
          drawClear: [(self) => shadeIntervals(self, shading)],
          drawAxes: [(self) => bounds && shadeBounds(self, bounds)],
        },
      },
      [Array.from({ length: steps }, (_, t) => t), ...curves.map((c) => c.values)],
      canvas,
    );
    const cursor = create('div', { className: 'mark cursor' });
    plot.over.append(cursor);
    this.#followPointer(plot, steps);
    this.#charts.push({ plot, cursor, values, curves });
  }

  /**
   * Moves the page's cursor on a click or drag.
   * @param {uPlot} plot
   * @param {number} steps
   */
  #followPointer(plot, steps) {
    const { over } = plot;
    /** @param {PointerEvent} event */
    const move = ({ clientX, timeStamp }) => {
      const x = clientX - over.getBoundingClientRect().left;
      const step = Math.round(plot.posToVal(x, 'x'));
      this.#store.set({ step: Math.min(Math.max(step, 0), steps - 1) }, { inputTime: timeStamp });
    };
    over.addEventListener('pointerdown', (event) => {
      if (event.button !== 0) return;
      over.setPointerCapture(event.pointerId);
      move(event);
    });
    over.addEventListener('pointermove', (event) => {
      if (over.hasPointerCapture(event.pointerId)) move(event);
    });
  }

  /** @param {Table} table */
  #table({ title, columns, rows, note = '' }) {
    const head = heading(title);
    const copied = () => csv([columns, ...rows]);
    head.append(copyButton('Copy CSV', `Copy ${title} as CSV`, copied));
    const body = create('tbody');
    const table = create('table', { ariaLabel: title }, create('thead'), body);
    const classes = columns.map((_, i) =>
      rows.every((row) => typeof row[i] !== 'string') ? 'number' : '',
    );
    const headings = columns.map((name, i) =>
      columnHeading(label(name), { className: classes[i] }),
    );
    fillTable(table, headings, []);
    const layers = new Set(['truth', 'fused', ...(this.#trace?.modalities ?? [])]);
    rows.forEach((row, r) => {
      const line = body.insertRow();
      const repeated = r > 0 && rows[r - 1][0] === row[0]; // its first cell is hidden
      if (r > 0 && !repeated) line.className = 'next';
      row.forEach((value, i) => {
        const cell = line.insertCell();
        cell.className = classes[i];
        if (i === 0 && repeated) cell.classList.add('again');
        if (i === 0 && !repeated && typeof value === 'string' && layers.has(value))
          cell.append(swatch(value));
        cell.append(typeof value === 'string' ? label(value) : significant(value));
      });
    });
    const scroll = create('div', { className: 'scroll', tabIndex: 0 }, table);
    scroll.ariaLabel = `${title}, table`;
    const explanation = note ? [create('p', { textContent: typeset(sentence(note)) })] : [];
    return create('div', { className: 'table' }, head, scroll, ...explanation);
  }
}

/**
 * Adds the unit to a title that does not name it.
 * @param {string} title
 * @param {string} unit
 */
function titleWithUnit(title, unit) {
  const mention = unit.length > 3 ? unit : `(${unit})`;
  return unit && !title.toLowerCase().includes(mention) ? `${title} (${unit})` : title;
}

/**
 * Groups the curves that share a chart, in their order.
 * @param {Curve[]} curves
 */
function curvesByChart(curves) {
  /** @type {Map<string, Curve[]>} */
  const groups = new Map();
  for (const curve of curves) groups.set(curve.chart, [...(groups.get(curve.chart) ?? []), curve]);
  return [...groups.values()];
}

/**
 * Returns the style of points without neighbours, which a line does not show, such as those of a slow sensor.
 * @param {(number | null)[]} values
 * @param {string} fill
 */
function isolatedPoints(values, fill) {
  const isolated = values.flatMap((value, i) =>
    value !== null && (values[i - 1] ?? null) === null && (values[i + 1] ?? null) === null
      ? [i]
      : [],
  );
  return isolated.length ? { show: true, size: 4, fill, filter: () => isolated } : { show: false };
}
