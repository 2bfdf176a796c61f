/**
 * Viewer of one run: every panel follows one cursor. A page (write_interactive) keeps it in the address as #step=42, a
 * notebook widget (RunWidget) in its attribute.
 */

/**
 * @typedef {(number | null)[]} Row
 * @typedef {{name: string, label: string, colour: string}} Layer
 * @typedef {{label: string, unit: string, truth: Row, mean: Row[], std: Row[]}} Component
 * @typedef {{name: string, mask: string}} Band
 * @typedef {{name: string, height: number, width: number, channels: number, data: string}} Images
 * @typedef {{stride: number, steps: [string, number[]][][], places: Row[][], truth: Row[]}} Scene
 * @typedef {object} Maps
 * @property {string} title
 * @property {number} stride
 * @property {Layer[]} layers
 * @property {[number, number, number]} shape
 * @property {string[]} axes
 * @property {number[]} reach half the side lengths
 * @property {Row[]} centres
 * @property {Row[][]} places
 * @property {Row[]} truth
 * @property {string} data
 * @typedef {object} Run
 * @property {number} dt
 * @property {number[] | null} times of the steps in s; null: steps times dt
 * @property {number} steps
 * @property {Layer[]} layers
 * @property {string} truth colour
 * @property {Component[]} components
 * @property {{label: string, unit: string, values: Row[]}} error
 * @property {{label: string, names: string[], colours: string[], values: Row[]} | null} weights
 * @property {Band[]} bands
 * @property {Images[]} images
 * @property {Scene | null} scene
 * @property {Maps | null} maps
 * @property {string} no_maps
 * @property {string} palette
 * @property {{step: number, error: string}[]} moments
 * @typedef {{label: string, unit: string, lines: {name: string, colour: string, values: Row, dash?: boolean}[], band?: {centre: Row, std: Row, colour: string}, stacked?: boolean, fromZero?: boolean}} Chart
 */

const scale = Math.max(1, window.devicePixelRatio);
const LEFT = 56; // px, of the charts
const SMALLEST_MAP = 120; // px
const LARGEST_MAP = 240;
/** Colours of the shaded groups of steps after the first one. */
const BAND_COLOURS = ['#7d8fb3', '#b09a4a', '#6f9e7c'];

/** @param {string} text base64 */
const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
/** @param {number | null | undefined} value */
const digits = (value) =>
  value == null ? '–' : Number(value.toPrecision(4)).toString().replaceAll('-', '−');

/**
 * @param {string} tag
 * @param {Record<string, unknown>} properties
 * @param {...(Node | string)} children
 */
function create(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

/**
 * @param {number} width in pixels
 * @param {number} height
 */
function bitmap(width, height) {
  const canvas = document.createElement('canvas');
  canvas.width = width;
  canvas.height = height;
  return canvas;
}

/**
 * @param {number} width in CSS px
 * @param {number} height
 */
function canvasOf(width, height) {
  const canvas = bitmap(Math.round(width * scale), Math.round(height * scale));
  canvas.style.width = `${width}px`;
  canvas.style.height = `${height}px`;
  return canvas;
}

/** @param {HTMLCanvasElement} canvas */
const context = (canvas) => /** @type {CanvasRenderingContext2D} */ (canvas.getContext('2d'));

/** Whether the notebook, or else the system, has a dark theme. */
function isDark() {
  const { dataset, classList } = document.body;
  if (dataset.jpThemeLight !== undefined) return dataset.jpThemeLight === 'false';
  if (dataset.vscodeThemeKind !== undefined) return !dataset.vscodeThemeKind.includes('light');
  return classList.contains('vscode-dark') || matchMedia('(prefers-color-scheme: dark)').matches;
}

/**
 * Lines in pale colours are darker on white.
 * @param {string} colour #rrggbb
 */
function legible(colour) {
  const [r, g, b] = [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16));
  const isPale = 0.3 * r + 0.6 * g + 0.1 * b > 190;
  return isPale && !isDark() ? `rgb(${0.6 * r} ${0.6 * g} ${0.6 * b})` : colour;
}

/**
 * Draws a marker: a plus for the truth, a ring for estimates.
 * @param {CanvasRenderingContext2D} c
 * @param {number} x
 * @param {number} y
 * @param {string} colour
 * @param {boolean} plus
 */
function marker(c, x, y, colour, plus) {
  c.strokeStyle = colour;
  c.lineWidth = 2 * scale;
  c.beginPath();
  if (plus) {
    c.moveTo(x - 7 * scale, y);
    c.lineTo(x + 7 * scale, y);
    c.moveTo(x, y - 7 * scale);
    c.lineTo(x, y + 7 * scale);
  } else c.arc(x, y, 5 * scale, 0, 7);
  c.stroke();
}

/** Charts, maps, scene, images and values of a run under one cursor. */
export class Viewer {
  /**
   * @param {Document | ShadowRoot} root contains the elements of body.html.j2
   * @param {Run} run
   * @param {(step: number) => void} onMove called with the step when the cursor moves
   */
  constructor(root, run, onMove) {
    this.root = root;
    this.run = run;
    this.onMove = onMove;
    this.step = 0;
    this.timer = 0;
    this.fused = run.layers.length - 1;
    /** Draw the panels of a step. @type {((t: number) => void)[]} */
    this.painters = [];
    /** Draw the cursor in the charts. @type {((t: number) => void)[]} */
    this.cursorPainters = [];
    this.frame = this.html('.run');
    this.frame.classList.toggle('dark', isDark());
    const colours = [this.css('--contact'), ...BAND_COLOURS];
    /** Masks of groups of steps, such as contact and blackout. */
    this.bands = run.bands.map(({ name, mask }, i) => ({
      name,
      colour: name === 'blackout' ? this.css('--muted') : colours[i % colours.length],
      mask: bytes(mask),
    }));
    for (const layer of run.layers) layer.colour = legible(layer.colour);
    run.weights?.colours.forEach((colour, k, colours) => (colours[k] = legible(colour)));
    this.cursor = /** @type {HTMLInputElement} */ (this.html('#cursor'));
    this.build();
    this.listen();
  }

  build() {
    const { run } = this;
    this.cursor.max = String(run.steps - 1);
    this.html('#events ol').append(
      ...run.moments.map(({ step: at, error }) =>
        create('li', {}, create('a', { href: `#step=${at}`, textContent: `step ${at}: ${error}` })),
      ),
    );
    if (run.scene) this.buildScene(run.scene);
    run.images.forEach((images) => this.buildImages(images));
    this.html('#images').hidden = !this.painters.length;
    if (run.maps) this.buildMaps(run.maps);
    else this.html('#maps h2').textContent = `No maps: ${run.no_maps}`;
  }

  listen() {
    this.cursor.addEventListener('input', () => this.move(Number(this.cursor.value)));
    this.html('#play').addEventListener('click', () => this.play());
    this.frame.addEventListener('click', (event) => {
      const target = event.target instanceof Element && event.target.closest('a[href^="#step="]');
      if (!target) return;
      event.preventDefault();
      this.move(Number(target.getAttribute('href')?.slice('#step='.length)));
    });
    let width = 0;
    const timeline = this.html('#timeline');
    new ResizeObserver(() => {
      if (timeline.clientWidth === width) return;
      width = timeline.clientWidth;
      this.buildTimeline();
      this.draw();
    }).observe(timeline);
  }

  /** @param {KeyboardEvent} event */
  press(event) {
    /** @type {Record<string, number>} */
    const targets = {
      ArrowLeft: this.step - 1,
      ArrowRight: this.step + 1,
      PageUp: this.step - 10,
      PageDown: this.step + 10,
      Home: 0,
      End: this.run.steps - 1,
    };
    const target = event.composedPath()[0];
    if (event.key === ' ' && !(target instanceof Element && target.closest('button, a')))
      this.play();
    else if (event.key in targets) this.move(targets[event.key]);
    else return;
    event.preventDefault();
    event.stopPropagation();
  }

  /** @param {number} target */
  move(target) {
    this.step = Math.min(Math.max(target || 0, 0), this.run.steps - 1);
    this.draw();
    this.onMove(this.step);
  }

  play() {
    clearInterval(this.timer);
    const button = this.html('#play');
    const isPlaying = button.textContent === '❚❚';
    button.textContent = isPlaying ? '▶' : '❚❚';
    const next = () => this.move(this.step + 1 < this.run.steps ? this.step + 1 : 0);
    if (!isPlaying) this.timer = window.setInterval(next, 1000 * this.run.dt);
  }

  draw() {
    for (const paint of this.painters) paint(this.step);
    for (const paint of this.cursorPainters) paint(this.step);
    this.showValues(this.step);
    this.cursor.value = String(this.step);
    const time = (this.run.times?.[this.step] ?? this.step * this.run.dt).toFixed(2);
    this.html('#place').textContent = `step ${this.step} of ${this.run.steps - 1}, ${time} s`;
  }

  /** @param {string} selector */
  html(selector) {
    return /** @type {HTMLElement} */ (this.root.querySelector(selector));
  }

  /** @param {string} name */
  css(name) {
    return getComputedStyle(this.frame).getPropertyValue(name);
  }

  /** @returns {Chart[]} */
  charts() {
    /** @type {Chart[]} */
    const result = [];
    const { weights, error, components, layers } = this.run;
    if (weights) {
      const lines = weights.names.map((name, k) => ({
        name,
        colour: weights.colours[k],
        values: weights.values[k],
      }));
      result.push({ label: weights.label, unit: '', lines, stacked: true });
    }
    const layerLines = (/** @type {Row[]} */ values) =>
      layers
        .map(({ label, colour }, l) => ({
          name: label,
          colour,
          values: values[l],
          dash: l < this.fused,
        }))
        .filter((line, l) => l === this.fused || line.values.some((v) => v !== null));
    for (const { label, unit, truth, mean, std } of components) {
      const lines = [{ name: 'truth', colour: this.run.truth, values: truth }, ...layerLines(mean)];
      const band = {
        centre: mean[this.fused],
        std: std[this.fused],
        colour: layers[this.fused].colour,
      };
      result.push({ label, unit, lines, band });
    }
    result.push({
      label: `${error.label} error`,
      unit: error.unit,
      lines: layerLines(error.values),
      fromZero: true,
    });
    return result;
  }

  /**
   * Draws everything of a chart but the cursor.
   * @param {Chart} chart
   * @param {number} width
   * @param {number} height
   */
  drawChart(chart, width, height) {
    const canvas = canvasOf(width, height);
    const c = context(canvas);
    c.scale(scale, scale);
    const values = chart.stacked
      ? [0, 1]
      : chart.lines.flatMap((line) => line.values.filter((v) => v !== null));
    if (chart.band)
      chart.band.centre.forEach((v, t) => {
        const s = chart.band?.std[t];
        if (v !== null && s != null) values.push(v - 2 * s, v + 2 * s);
      });
    if (chart.fromZero) values.push(0);
    let [low, high] = [Math.min(...values), Math.max(...values)];
    if (!(high > low)) [low, high] = [low - 1, low + 1];
    const x = (/** @type {number} */ t) =>
      LEFT + ((width - LEFT - 8) * t) / Math.max(1, this.run.steps - 1);
    const y = (/** @type {number} */ v) => height - 5 - ((height - 10) * (v - low)) / (high - low);
    for (const { colour, mask } of this.bands) {
      c.fillStyle = colour;
      c.globalAlpha = 0.18;
      mask.forEach((on, t) => on && c.fillRect(x(t - 0.5), 0, x(1) - x(0), height));
    }
    c.globalAlpha = 1;
    c.fillStyle = this.css('--muted');
    c.font = '11px system-ui';
    c.textAlign = 'right';
    c.fillText(digits(high), LEFT - 6, 12);
    c.fillText(digits(low), LEFT - 6, height - 3);
    c.strokeStyle = this.css('--grid');
    c.strokeRect(LEFT, 1, width - LEFT - 8, height - 2);
    c.beginPath();
    c.rect(LEFT, 0, width - LEFT - 8, height);
    c.clip();
    if (chart.stacked) this.drawStack(c, chart, x, y);
    else this.drawLines(c, chart, x, y);
    return canvas;
  }

  /**
   * @param {CanvasRenderingContext2D} c
   * @param {Chart} chart
   * @param {(t: number) => number} x
   * @param {(v: number) => number} y
   */
  drawStack(c, { lines }, x, y) {
    const total = Array.from({ length: this.run.steps }, (_, t) =>
      lines.reduce((sum, { values }) => sum + (values[t] ?? 0), 0),
    );
    const base = new Float64Array(this.run.steps);
    for (const { values, colour } of lines) {
      c.fillStyle = colour;
      for (let t = 0; t < this.run.steps; t++) {
        const share = (values[t] ?? 0) / (total[t] || 1);
        const top = y(base[t] + share);
        c.fillRect(x(t - 0.5), top, x(1) - x(0) + 0.5, y(base[t]) - top);
        base[t] += share;
      }
    }
  }

  /**
   * @param {CanvasRenderingContext2D} c
   * @param {Chart} chart
   * @param {(t: number) => number} x
   * @param {(v: number) => number} y
   */
  drawLines(c, { lines, band }, x, y) {
    if (band) {
      c.fillStyle = band.colour;
      c.globalAlpha = 0.2;
      band.centre.forEach((v, t) => {
        const s = band.std[t];
        if (v !== null && s !== null)
          c.fillRect(x(t - 0.5), y(v + 2 * s), x(1) - x(0), y(v - 2 * s) - y(v + 2 * s));
      });
      c.globalAlpha = 1;
    }
    for (const { values, colour, dash } of lines) {
      c.strokeStyle = colour;
      c.lineWidth = dash ? 1.2 : 1.8;
      c.setLineDash(dash ? [4, 3] : []);
      c.beginPath();
      values.forEach(
        (v, t) => v !== null && c[t && values[t - 1] !== null ? 'lineTo' : 'moveTo'](x(t), y(v)),
      );
      c.stroke();
    }
    c.setLineDash([]);
  }

  buildTimeline() {
    const host = this.html('#timeline');
    host.replaceChildren();
    this.cursorPainters = [];
    const width = host.clientWidth - 24;
    for (const chart of this.charts()) {
      const height = chart.stacked ? 64 : 92;
      const drawn = this.drawChart(chart, width, height);
      const canvas = canvasOf(width, height);
      const c = context(canvas);
      this.cursorPainters.push((t) => {
        c.clearRect(0, 0, canvas.width, canvas.height);
        c.drawImage(drawn, 0, 0);
        c.fillStyle = this.css('--ink');
        const x = LEFT + ((width - LEFT - 8) * t) / Math.max(1, this.run.steps - 1);
        c.fillRect(x * scale - 1, 0, 2, canvas.height);
      });
      const point = (/** @type {PointerEvent} */ event) => {
        if (event.type === 'pointermove' && !event.buttons) return;
        const share = (event.offsetX - LEFT) / (canvas.clientWidth - LEFT - 8);
        this.move(Math.round(share * (this.run.steps - 1)));
      };
      canvas.addEventListener('pointerdown', point);
      canvas.addEventListener('pointermove', point);
      const entries = chart.lines.map(({ name, colour }) => {
        const sample = create('i');
        sample.style.setProperty('--c', colour);
        return create('span', {}, sample, name);
      });
      if (!host.childElementCount)
        for (const { name, colour, mask } of this.bands)
          if (mask.includes(1)) {
            const sample = create('i', { className: 'band' });
            sample.style.setProperty('--c', colour);
            entries.push(create('span', {}, sample, name));
          }
      const title = create('b', {
        textContent: chart.unit ? `${chart.label} (${chart.unit})` : chart.label,
      });
      host.append(create('div', { className: 'legend' }, title, ...entries), canvas);
    }
  }

  /** @param {Maps} maps */
  buildMaps(maps) {
    const [, rows, columns] = maps.shape;
    const side = this.html('#maps').clientWidth / maps.layers.length - 20;
    const size = Math.round(Math.min(LARGEST_MAP, Math.max(SMALLEST_MAP, side)));
    const data = bytes(maps.data);
    const palette = bytes(this.run.palette);
    const isCurve = rows === 1;
    this.html('#maps h2').textContent = maps.title;
    const sides = maps.axes.map((axis, i) => `${axis} ±${digits(maps.reach[i])}`);
    this.html('#maps p').textContent =
      `${sides.join(', ')} around the truth (plus). Ring: estimate.`;
    maps.layers.forEach(({ name }, l) => {
      const canvas = canvasOf(size, isCurve ? size / 2 : size);
      const c = context(canvas);
      const pixels = bitmap(columns, rows);
      const image = context(pixels).createImageData(columns, rows);
      const caption = create('figcaption', { textContent: name });
      this.html('#maps > div').append(create('figure', {}, canvas, caption));
      this.painters.push((t) => {
        const index = Math.floor(t / maps.stride);
        const first = (index * maps.layers.length + l) * rows * columns;
        if (isCurve) {
          c.clearRect(0, 0, canvas.width, canvas.height);
          c.fillStyle = this.css('--muted');
          const width = canvas.width / columns;
          for (let column = 0; column < columns; column++) {
            const height = (data[first + column] / 255) * canvas.height;
            c.fillRect(column * width, canvas.height - height, width + 0.5, height);
          }
        } else {
          for (let row = 0; row < rows; row++)
            for (let column = 0; column < columns; column++) {
              const value = 3 * data[first + row * columns + column];
              const at = 4 * ((rows - 1 - row) * columns + column);
              image.data.set([palette[value], palette[value + 1], palette[value + 2], 255], at);
            }
          context(pixels).putImageData(image, 0, 0);
          c.imageSmoothingEnabled = false;
          c.drawImage(pixels, 0, 0, canvas.width, canvas.height);
        }
        const centre = maps.centres[index];
        const draw = (
          /** @type {Row} */ place,
          /** @type {string} */ colour,
          /** @type {boolean} */ plus,
        ) => {
          const [dx, dy] = maps.reach.map(
            (reach, i) => ((place[i] ?? NaN) - (centre[i] ?? NaN)) / reach,
          );
          const y = isCurve ? 0.5 : 0.5 - 0.5 * dy;
          if (!plus)
            caption.textContent =
              Math.max(Math.abs(dx), Math.abs(dy || 0)) > 1 ? `${name}; estimate outside` : name;
          if (Number.isFinite(dx))
            marker(c, (0.5 + 0.5 * dx) * canvas.width, y * canvas.height, colour, plus);
        };
        draw(maps.truth[t], isCurve ? this.run.truth : '#fff', true);
        draw(maps.places[t][this.fused], this.run.layers[this.fused].colour, false);
      });
    });
  }

  /** @param {Scene} scene */
  buildScene(scene) {
    const points = scene.steps.flatMap((shapes) => shapes.flatMap(([, outline]) => outline));
    const xs = points.filter((_, i) => i % 2 === 0);
    const ys = points.filter((_, i) => i % 2 === 1);
    const range = (/** @type {number[]} */ v) =>
      v.reduce(([a, b], x) => [Math.min(a, x), Math.max(b, x)], [Infinity, -Infinity]);
    const [[left, right], [bottom, top]] = [range(xs), range(ys)];
    const width = 300;
    const factor = ((width - 12) * scale) / (right - left);
    const canvas = canvasOf(width, Math.min(360, ((top - bottom) * factor) / scale + 12));
    const c = context(canvas);
    const at = (/** @type {number} */ x, /** @type {number} */ y) =>
      /** @type {[number, number]} */ ([
        6 * scale + (x - left) * factor,
        canvas.height - 6 * scale - (y - bottom) * factor,
      ]);
    this.html('#images').append(
      create('figure', {}, canvas, create('figcaption', { textContent: 'from above' })),
    );
    this.painters.push((t) => {
      c.clearRect(0, 0, canvas.width, canvas.height);
      for (const [colour, outline] of scene.steps[Math.floor(t / scene.stride)]) {
        c.beginPath();
        for (let i = 0; i < outline.length; i += 2) c.lineTo(...at(outline[i], outline[i + 1]));
        c.closePath();
        c.fillStyle = colour;
        c.globalAlpha = 0.6;
        c.fill();
        c.globalAlpha = 1;
        c.lineWidth = scale;
        c.strokeStyle = this.css('--muted');
        c.stroke();
      }
      this.run.layers.forEach(({ colour }, l) => {
        const [x, y] = scene.places[t][l];
        if (x != null && y != null) marker(c, ...at(x, y), colour, false);
      });
      const [x, y] = scene.truth[t];
      if (x != null && y != null) marker(c, ...at(x, y), this.run.truth, true);
    });
  }

  /** @param {Images} images */
  buildImages({ name, width, height, channels, data }) {
    const values = bytes(data);
    const canvas = canvasOf(140, (140 * height) / width);
    const pixels = bitmap(width, height);
    const image = context(pixels).createImageData(width, height);
    this.html('#images').append(
      create('figure', {}, canvas, create('figcaption', { textContent: name })),
    );
    this.painters.push((t) => {
      const first = t * width * height * channels;
      for (let i = 0; i < width * height; i++) {
        const at = first + i * channels;
        const green = channels === 3 ? at + 1 : at;
        const blue = channels === 3 ? at + 2 : at;
        image.data.set([values[at], values[green], values[blue], 255], 4 * i);
      }
      context(pixels).putImageData(image, 0, 0);
      const c = context(canvas);
      c.imageSmoothingEnabled = false;
      c.drawImage(pixels, 0, 0, canvas.width, canvas.height);
    });
  }

  /** @param {number} t */
  showValues(t) {
    const heads = ['', `${this.run.error.label} error (${this.run.error.unit})`];
    for (const { label, unit } of this.run.components) heads.push(`${label} (${unit})`, 'σ');
    const weights = this.run.weights;
    if (weights) heads.push(weights.label);
    const reported = (/** @type {number} */ l) =>
      this.run.components.some(({ mean }) => mean[l].some((v) => v !== null));
    const cells = this.run.layers.flatMap(({ name, label }, l) => {
      if (!weights && l !== this.fused && !reported(l)) return [];
      const values = [label, digits(this.run.error.values[l][t])];
      for (const { mean, std } of this.run.components)
        values.push(digits(mean[l][t]), digits(std[l][t]));
      if (weights) values.push(digits(weights.values[weights.names.indexOf(name)]?.[t]));
      return [values];
    });
    const row = (/** @type {string[]} */ texts, /** @type {string} */ tag) =>
      create('tr', {}, ...texts.map((textContent, i) => create(i ? tag : 'th', { textContent })));
    this.html('#values table').replaceChildren(
      create('thead', {}, row(heads, 'th')),
      create('tbody', {}, ...cells.map((texts) => row(texts, 'td'))),
    );
  }
}

/** The viewer of a page: the address has the step, and keys move the cursor. */
export function openPage() {
  const run = JSON.parse(document.querySelector('#run')?.textContent ?? '');
  const viewer = new Viewer(document, run, (step) =>
    history.replaceState(null, '', `#step=${step}`),
  );
  const followAddress = () => {
    const [, text] = location.hash.match(/^#step=(\d+)$/) ?? [];
    viewer.move(text === undefined ? (viewer.run.moments[0]?.step ?? 0) : Number(text));
  };
  window.addEventListener('hashchange', followAddress);
  document.addEventListener('keydown', (event) => viewer.press(event));
  followAddress();
}
