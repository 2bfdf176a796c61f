/** What a diagnostic found, drawn: curves over the steps with the page's cursor, plots, pictures and tables. */

import { FONT, GUTTER, LABEL, shadeBounds, shadeIntervals } from '../timeline/chart.js';
import { copyText } from '../core/clipboard.js';
import {
  COLOUR_TABLES,
  colour,
  cssVariable,
  lineStyle,
  lineSample,
  scaled,
  swatch,
} from '../core/palette.js';
import { intervals } from '../data/trace.js';
import { significant, displayName } from '../core/units.js';

const HEIGHT = { chart: scaled(104), axis: scaled(30), plot: scaled(190) }; // px
const AGAIN = [
  [9, 3, 2, 3],
  [1.5, 3],
  [4, 2],
  [12, 4],
]; // dashes of the second line of a layer, the third …
const MARGIN = 0.06; // of a range, above and below
const TOLD = 1500; // ms

export class Figures {
  #host;
  #store;
  #found = null;
  #trace = null;
  #charts = [];
  #plots = [];
  #width = 0;

  /** @param {HTMLElement} host @param {import('../core/state.js').Store} store */
  constructor(host, store) {
    [this.#host, this.#store] = [host, store];
    new ResizeObserver(() => host.clientWidth !== this.#width && this.redraw()).observe(host);
  }

  /** @param {import('../data/api.js').DiagnosticResult | null} found @param {import('../data/trace.js').Trace | null} trace that the page shows, null where it is of no single one */
  show(found, trace) {
    if (found === this.#found && trace === this.#trace) return;
    [this.#found, this.#trace] = [found, trace];
    this.redraw();
  }

  /** Draws all anew: for other results, another width, other colours. */
  redraw() {
    for (const plot of [...this.#charts.map((c) => c.plot), ...this.#plots]) plot.destroy();
    [this.#charts, this.#plots] = [[], []];
    this.#width = this.#host.clientWidth;
    const found = this.#found;
    if (!found || !this.#width) {
      if (!found) this.#host.replaceChildren();
      return;
    }
    const { scrollTop } = this.#host.parentElement;
    const [charts, panels] = [block('curves'), block('panels')];
    this.#host.replaceChildren(charts, panels, ...found.tables.map((table) => this.#table(table)));
    const groups = grouped(found.curves);
    groups.forEach((curves, i) => this.#chart(charts, curves, i === groups.length - 1));
    for (const plot of found.plots) this.#plot(panels, plot);
    for (const image of found.images) panels.append(drawn(image));
    this.#host.parentElement.scrollTop = scrollTop;
  }

  /** Moves the cursor; nothing is drawn again. */
  move(step) {
    for (const { plot, mark, values, curves } of this.#charts) {
      const x = plot.valToPos(step, 'x');
      mark.style.transform = `translateX(${x.toFixed(2)}px)`;
      values.forEach((cell, i) => (cell.textContent = significant(curves[i].values[step])));
    }
  }

  #chart(parent, curves, last) {
    const figure = document.createElement('figure');
    const styles = curves.map((curve, i) =>
      style(curve.layer, curves.slice(0, i).filter((c) => c.layer === curve.layer).length),
    );
    const { unit, chart } = curves[0];
    const head = heading(
      unit && !chart.toLowerCase().includes(unit.length > 3 ? unit : `(${unit})`)
        ? `${chart} (${unit})`
        : chart,
    );
    const values = curves.map(() => document.createElement('b'));
    head.append(...curves.map((curve, i) => key(styles[i], named(curve.name), values[i])));
    const canvas = document.createElement('div');
    canvas.className = 'canvas';
    canvas.setAttribute('role', 'img');
    canvas.setAttribute(
      'aria-label',
      `${chart} over steps: ${curves.map((c) => c.name).join(', ')}`,
    );
    figure.append(head, canvas);
    parent.append(figure);
    const steps = curves[0].values.length;
    const bounds = curves.map((c) => c.bounds).find(Boolean);
    const limits = padded(extent([...curves.flatMap((c) => c.values), ...(bounds ?? [])]));
    const shading = {
      contact: bandOf(this.#found, 'contact'),
      blackout: bandOf(this.#found, 'blackout'),
      edits: bandOf(this.#found, 'edit'),
    };
    const plot = new uPlot(
      {
        width: this.#width,
        height: HEIGHT.chart + (last ? HEIGHT.axis - 4 : 0),
        padding: [4, GUTTER.right, last ? 0 : 4, 0],
        cursor: { show: false },
        legend: { show: false },
        select: { show: false },
        scales: {
          x: { time: false, range: () => [0, Math.max(1, steps - 1)] },
          y: { range: () => limits },
        },
        axes: [
          {
            ...ink(),
            gap: 2,
            space: scaled(60),
            size: last ? HEIGHT.axis - LABEL.labelSize : 0,
            ...(last
              ? { label: 'step', ...LABEL }
              : { ticks: { show: false }, values: (_, splits) => splits.map(() => '') }),
          },
          { ...ink(), size: GUTTER.left, gap: 3, space: scaled(20) },
        ],
        series: [
          {},
          ...styles.map(({ stroke, dash, width }) => ({
            stroke,
            dash,
            width,
            points: { show: false },
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
    const mark = document.createElement('div');
    mark.className = 'mark cursor';
    plot.over.append(mark);
    this.#scrub(plot, steps);
    this.#charts.push({ plot, mark, values, curves });
  }

  /** Click or drag moves the page's cursor. */
  #scrub(plot, steps) {
    const to = (event) => {
      const step = Math.round(
        plot.posToVal(event.clientX - plot.over.getBoundingClientRect().left, 'x'),
      );
      this.#store.set(
        { step: Math.min(Math.max(step, 0), steps - 1) },
        { inputTime: event.timeStamp },
      );
    };
    plot.over.addEventListener('pointerdown', (event) => {
      if (event.button !== 0) return;
      plot.over.setPointerCapture(event.pointerId);
      to(event);
    });
    plot.over.addEventListener(
      'pointermove',
      (event) => plot.over.hasPointerCapture(event.pointerId) && to(event),
    );
  }

  #plot(parent, plot) {
    const figure = document.createElement('figure');
    const styles = plot.lines.map((l, i) =>
      style(l.layer, plot.lines.slice(0, i).filter((o) => o.layer === l.layer).length),
    );
    const head = heading(plot.title);
    head.append(...plot.lines.flatMap((l, i) => (l.name ? [key(styles[i], named(l.name))] : [])));
    const canvas = document.createElement('div');
    canvas.className = 'canvas';
    canvas.setAttribute('role', 'img');
    canvas.setAttribute('aria-label', `${plot.title}: ${plot.y_label} over ${plot.x_label}`);
    figure.append(head, canvas);
    parent.append(figure);
    const bars = plot.kind === 'bars';
    const xs = plot.lines.flatMap((l) => l.x);
    const ideal = plot.diagonal ? [0, 1] : [];
    const wide = bars ? spacing(xs) : 0;
    const [left, right] = extent([...xs, ...ideal]);
    const y = padded(extent([...plot.lines.flatMap((l) => l.y), ...ideal, ...(bars ? [0] : [])]));
    const x = bars
      ? [left - 0.6 * wide, right + 0.6 * wide]
      : plot.kind === 'points'
        ? padded([left, right])
        : [left, right];
    const small = { label: plot.x_label, ...LABEL };
    const made = new uPlot(
      {
        width: figure.clientWidth,
        height: HEIGHT.plot,
        padding: [4, 10, 0, 0],
        cursor: { show: false },
        legend: { show: false },
        select: { show: false },
        scales: {
          x: { time: false, range: () => (x[1] > x[0] ? x : [x[0] - 1, x[0] + 1]) },
          y: { range: () => y },
        },
        axes: [
          {
            ...ink(),
            ...small,
            size: scaled(16),
            gap: 2,
            space: scaled(40),
            ...(bars && xs.every(Number.isInteger)
              ? { incrs: [1, 2, 5, 10, 20, 50, 100, 1000] }
              : {}),
            ...(plot.names?.length
              ? {
                  space: 1,
                  size: scaled(58),
                  rotate: 38,
                  values: (_, at) => at.map((x) => plot.names[x] ?? ''),
                }
              : {}),
          },
          { ...ink(), ...small, label: plot.y_label, size: scaled(40), gap: 3, space: scaled(24) },
        ],
        series: [{}, { show: false }],
        hooks: { draw: [(self) => trace(self, plot, styles, wide)] },
      },
      [x, [null, null]],
      canvas,
    );
    canvas.title = '';
    made.over.addEventListener('pointermove', (event) => {
      canvas.title = `${significant(made.posToVal(event.offsetX, 'x'))}, ${significant(made.posToVal(event.offsetY, 'y'))}`;
    });
    this.#plots.push(made);
  }

  #table({ title, columns, rows }) {
    const host = block('table');
    const copy = document.createElement('button');
    [copy.type, copy.className, copy.textContent] = ['button', 'text quiet', 'Copy CSV'];
    copy.setAttribute('aria-label', `Copy ${title} as CSV`);
    copy.addEventListener('click', async () => {
      const done = await copyText(
        [columns, ...rows].map((row) => row.map(field).join(',')).join('\n') + '\n',
      );
      copy.textContent = done ? 'Copied' : 'Not allowed';
      setTimeout(() => (copy.textContent = 'Copy CSV'), TOLD);
    });
    const head = heading(title);
    head.append(copy);
    const table = document.createElement('table');
    table.setAttribute('aria-label', title);
    const numeric = columns.map((_, i) => rows.every((row) => typeof row[i] !== 'string'));
    const top = table.createTHead().insertRow();
    columns.forEach((name, i) => {
      const cell = document.createElement('th');
      [cell.scope, cell.textContent, cell.className] = [
        'col',
        named(name),
        numeric[i] ? 'number' : '',
      ];
      top.append(cell);
    });
    const body = table.createTBody();
    rows.forEach((row, r) => {
      const line = body.insertRow();
      row.forEach((value, i) => {
        const cell = line.insertCell();
        cell.className = numeric[i] ? 'number' : '';
        const again = i === 0 && r > 0 && rows[r - 1][0] === value;
        if (i === 0 && r > 0 && !again) line.className = 'next';
        if (again) cell.classList.add('again');
        if (i === 0 && !again && this.#layers.has(value)) cell.append(swatch(value));
        cell.append(typeof value === 'string' ? named(value) : significant(value));
      });
    });
    const scroll = block('scroll');
    scroll.tabIndex = 0;
    scroll.setAttribute('aria-label', `${title}, table`);
    scroll.append(table);
    host.append(head, scroll);
    return host;
  }

  get #layers() {
    return new Set(['truth', 'fused', ...(this.#trace?.modalities ?? [])]);
  }
}

const named = (text) => displayName(text).replaceAll('+', ' + ');

function block(name) {
  const element = document.createElement('div');
  element.className = name;
  return element;
}

function heading(title) {
  const head = document.createElement('div');
  head.className = 'head';
  const text = document.createElement('h4');
  text.textContent = named(title);
  head.append(text);
  return head;
}

/** One line's name in a legend, with its value where there is one. */
function key({ property, dash, width }, name, value) {
  const element = document.createElement('span');
  element.className = 'line';
  element.append(lineSample(property, dash, width), name, ...(value ? [' ', value] : []));
  return element;
}

/** How the nth line of a layer is drawn: its colour says whose it is, its dash which. */
function style(layer, nth) {
  if (!layer)
    return {
      property: '--ink',
      stroke: colour('ink'),
      dash: nth ? AGAIN[(nth - 1) % AGAIN.length] : [],
      width: 1.5,
    };
  const { stroke, dash, width } = lineStyle(layer);
  return {
    property: cssVariable(layer),
    stroke,
    dash: nth ? AGAIN[(nth - 1) % AGAIN.length] : dash,
    width: nth ? 1.5 : width,
  };
}

/** Curves that share their axes, in their order. */
function grouped(curves) {
  const groups = new Map();
  for (const curve of curves) groups.set(curve.chart, [...(groups.get(curve.chart) ?? []), curve]);
  return [...groups.values()];
}

const bandOf = (found, kind) => intervals(found.bands[kind] ?? []);

function ink() {
  return {
    stroke: colour('muted'),
    grid: { stroke: colour('grid'), width: 1 },
    ticks: { stroke: colour('grid'), size: 4, width: 1 },
    font: FONT,
  };
}

function extent(values) {
  let [low, high] = [Infinity, -Infinity];
  for (const value of values) {
    if (!Number.isFinite(value)) continue;
    low = Math.min(low, value);
    high = Math.max(high, value);
  }
  return Number.isFinite(low) ? [low, high] : [0, 1];
}

function padded([low, high]) {
  const margin = MARGIN * (high - low) || 1;
  return [low === 0 ? -margin / 4 : low - margin, high + margin];
}

function spacing(xs) {
  const sorted = [...new Set(xs)].sort((a, b) => a - b);
  return Math.min(
    ...sorted.slice(1).map((x, i) => x - sorted[i]),
    sorted.length > 1 ? Infinity : 1,
  );
}

/** The lines, points or bars of a plot. */
function trace(plot, { lines, kind, diagonal }, styles, wide) {
  const { ctx, bbox } = plot;
  const ratio = devicePixelRatio;
  const [px, py] = [(x) => plot.valToPos(x, 'x', true), (y) => plot.valToPos(y, 'y', true)];
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  if (diagonal)
    stroke(
      ctx,
      colour('muted'),
      [4, 3],
      1,
      () => (ctx.moveTo(px(0), py(0)), ctx.lineTo(px(1), py(1))),
    );
  lines.forEach(({ x, y }, i) => {
    ctx.fillStyle = styles[i].stroke;
    const points = x.map((v, j) => [v, y[j]]).filter((point) => point.every(Number.isFinite));
    if (kind === 'bars') {
      const each = (0.8 * wide) / lines.length;
      for (const [at, value] of points) {
        const left = at + (i - lines.length / 2) * each;
        ctx.fillRect(
          px(left),
          py(Math.max(value, 0)),
          0.9 * (px(left + each) - px(left)),
          Math.abs(py(value) - py(0)),
        );
      }
    } else if (kind === 'points') {
      for (const [at, value] of points) {
        ctx.beginPath();
        ctx.arc(px(at), py(value), 1.6 * ratio, 0, 2 * Math.PI);
        ctx.fill();
      }
    } else {
      stroke(ctx, styles[i].stroke, styles[i].dash, styles[i].width, () =>
        points.forEach(([at, value], j) => ctx[j ? 'lineTo' : 'moveTo'](px(at), py(value))),
      );
    }
  });
  ctx.restore();
}

function stroke(ctx, colour_, dash, width, draw) {
  ctx.strokeStyle = colour_;
  ctx.lineWidth = width * devicePixelRatio;
  ctx.setLineDash(dash.map((d) => d * devicePixelRatio));
  ctx.beginPath();
  draw();
  ctx.stroke();
}

/** A value per pixel, with its colour bar; the value under the pointer. */
function drawn({ title, values, unit, signed }) {
  const figure = document.createElement('figure');
  figure.className = 'picture';
  const [height, width] = [values.length, values[0].length];
  const [least, most] = extent(values.flat());
  const reach = Math.max(Math.abs(least), Math.abs(most)) || 1;
  const [low, high] = signed ? [-reach, reach] : [least, most > least ? most : least + 1];
  const shades = signed ? COLOUR_TABLES.diverging : COLOUR_TABLES.viridis;
  const canvas = document.createElement('canvas');
  [canvas.width, canvas.height] = [width, height];
  canvas.setAttribute('role', 'img');
  canvas.setAttribute(
    'aria-label',
    `${title}: from ${significant(least)} to ${significant(most)} ${unit}`,
  );
  const image = new ImageData(width, height);
  const pixels = new Uint32Array(image.data.buffer);
  values
    .flat()
    .forEach(
      (v, i) =>
        (pixels[i] = Number.isFinite(v) ? shades[Math.round((255 * (v - low)) / (high - low))] : 0),
    );
  canvas.getContext('2d').putImageData(image, 0, 0);
  const bar = document.createElement('canvas');
  [bar.width, bar.height, bar.className] = [256, 1, 'bar-of-colours'];
  const colours = new ImageData(256, 1);
  new Uint32Array(colours.data.buffer).set(shades);
  bar.getContext('2d').putImageData(colours, 0, 0);
  const caption = document.createElement('figcaption');
  const whole = document.createElement('span');
  whole.append(significant(low), bar, `${significant(high)} ${unit}`);
  const under = document.createElement('output');
  caption.append(whole, under);
  canvas.addEventListener('pointermove', (event) => {
    const [column, row] = [
      (event.offsetX / canvas.clientWidth) * width,
      (event.offsetY / canvas.clientHeight) * height,
    ].map(Math.floor);
    const value = values[row]?.[column];
    under.textContent =
      value === undefined ? '' : `column ${column}, row ${row}: ${significant(value)} ${unit}`;
  });
  canvas.addEventListener('pointerleave', () => (under.textContent = ''));
  figure.append(heading(title), canvas, caption);
  return figure;
}

/** A value in a file of comma-separated values. */
function field(value) {
  if (value === null) return '';
  return /[",\n]/.test(value) ? `"${String(value).replaceAll('"', '""')}"` : String(value);
}
