/** Grouped bars with error bars and dots as SVG, each bar a link; colours and textures of filters, also for legends. */

import { svgElement } from '../core/dom.js';
import { scaled } from '../core/colours.js';
import { fixed, niceStep } from '../core/units.js';
import { estimatorOf } from './filter_colours.js';

/** Texture by estimator. @type {Record<string, string>} */
const TEXTURES = { pf: 'M-1 5 5-1M1 7 7 1', ukf: 'M1 2h2M4 5h2', lstm: 'M0 1.5h6M0 4.5h6' };
const TEXTURE_SIZE = 6; // px
const MARGIN = { left: scaled(34), right: scaled(6), top: scaled(16), bottom: scaled(22) }; // px
const MAX_HEIGHT = 2.5; // times the median bar: taller bars are cut off and show their value
const BAR_SHARE = 0.86; // of the width of a group
const TICKS = 5; // of the scale, about

/**
 * @typedef {object} Bar
 * @property {string} filter
 * @property {string} colour its property
 * @property {number | null} mean
 * @property {number | null} spread
 * @property {{value: number, here: boolean}[]} dots one per seed; here: whether the link opens this seed
 * @property {string | null} href null if there is nothing to open
 * @property {string} label complete description
 *
 * @typedef {object} Chart
 * @property {string} label
 * @property {string} unit of the scale
 * @property {{name: string, bars: Bar[]}[]} groups
 * @property {{name: string, value: number} | null} level a dashed line
 *
 * @typedef {object} Scale
 * @property {number} top largest displayed value
 * @property {(value: number) => number} y position in px
 */

export class BarChart {
  #host;
  #onPoint;
  /** @type {Chart | null} */
  #chart = null;
  /** @type {Map<Element, Bar>} */
  #bars = new Map();
  #width = 0;

  /**
   * @param {HTMLElement} host
   * @param {(bar: Bar | null) => void} onPoint called with the bar under the pointer or with the focus
   */
  constructor(host, onPoint) {
    this.#host = host;
    this.#onPoint = onPoint;
    const redraw = () => this.#host.clientWidth !== this.#width && this.#draw();
    new ResizeObserver(redraw).observe(host);
    navigateLinks(host);
    /** @param {Event} event */
    const point = ({ target }) => {
      const link = target instanceof Element ? target.closest('a') : null;
      this.#onPoint((link && this.#bars.get(link)) ?? null);
    };
    for (const kind of ['pointerover', 'focusin']) host.addEventListener(kind, point);
    for (const kind of ['pointerleave', 'focusout'])
      host.addEventListener(kind, () => this.#onPoint(null));
  }

  /** @param {Chart | null} chart */
  show(chart) {
    this.#chart = chart;
    this.#draw();
  }

  /**
   * Highlights the bars of a filter; of none for an empty name.
   * @param {string} filter
   */
  mark(filter) {
    for (const [link, bar] of this.#bars) link.classList.toggle('here', bar.filter === filter);
  }

  #draw() {
    const [width, height] = [(this.#width = this.#host.clientWidth), this.#host.clientHeight];
    const focused = [...this.#bars.keys()].findIndex((link) => link === document.activeElement);
    this.#host.replaceChildren();
    this.#bars.clear();
    if (!this.#chart || !width) return;
    const { label, unit, groups, level } = this.#chart;
    const bars = groups.flatMap((group) => group.bars);
    const top = scaleTop(bars, level);
    const innerHeight = height - MARGIN.top - MARGIN.bottom;
    /** @type {Scale} */
    const scale = { top, y: (v) => MARGIN.top + innerHeight * (1 - Math.min(v, top) / top) };
    const svg = svgElement(
      'svg',
      { viewBox: `0 0 ${width} ${height}`, width, height, role: 'group', 'aria-label': label },
      textureDefinitions(bars),
      ...gridLines(scale, width),
      svgElement('text', { x: 2, y: scaled(10) }, unit),
    );
    const groupWidth = (width - MARGIN.left - MARGIN.right) / groups.length;
    groups.forEach(({ name, bars: members }, g) => {
      const left = MARGIN.left + (g + (1 - BAR_SHARE) / 2) * groupWidth;
      const middle = left + (BAR_SHARE * groupWidth) / 2;
      const barWidth = (BAR_SHARE * groupWidth) / members.length;
      svg.append(
        svgElement('text', { x: middle, y: height - scaled(7), 'text-anchor': 'middle' }, name),
        ...members.map((bar, i) => this.#link(bar, left + i * barWidth, barWidth, scale)),
      );
    });
    if (level && level.value <= top) svg.append(...levelLine(level, scale, width));
    this.#host.append(svg);
    const links = svg.querySelectorAll('a');
    links.forEach((link, i) => (link.tabIndex = i === Math.max(0, focused) ? 0 : -1));
    if (focused >= 0) links[focused]?.focus();
  }

  /**
   * @param {Bar} bar
   * @param {number} left px
   * @param {number} width px
   * @param {Scale} scale
   */
  #link(bar, left, width, scale) {
    const link = svgElement('a', {
      class: 'bar-link',
      'aria-label': bar.label,
      ...(bar.href === null ? { role: 'img' } : { href: bar.href }),
    });
    this.#bars.set(link, bar);
    const bottom = scale.y(0);
    link.append(
      svgElement('rect', {
        class: 'hit',
        x: left,
        y: MARGIN.top - 4,
        width,
        height: bottom - MARGIN.top + 4,
      }),
      ...(bar.mean === null
        ? [missingMark(left + width / 2, bottom)]
        : barShapes(bar, bar.mean, left, width, scale)),
    );
    return link;
  }
}

/**
 * @param {Scale} scale
 * @param {number} width px
 */
function gridLines({ top, y }, width) {
  const step = niceStep(top / TICKS);
  const digits = step < 0.1 ? 2 : step < 1 ? 1 : 0;
  const values = Array.from({ length: Math.floor(top / step) + 1 }, (_, i) => i * step);
  return values.flatMap((value) => [
    svgElement('path', {
      class: value ? 'grid' : 'ground',
      d: `M${MARGIN.left} ${y(value)}H${width - MARGIN.right}`,
    }),
    svgElement(
      'text',
      { x: MARGIN.left - 5, y: y(value) + scaled(4), 'text-anchor': 'end' },
      fixed(value, digits),
    ),
  ]);
}

/**
 * @param {{name: string, value: number}} level
 * @param {Scale} scale
 * @param {number} width px
 */
function levelLine({ name, value }, { y }, width) {
  const right = width - MARGIN.right;
  return [
    svgElement('path', { class: 'level', d: `M${MARGIN.left} ${y(value)}H${right}` }),
    svgElement('text', { x: right, y: y(value) - 4, 'text-anchor': 'end' }, name),
  ];
}

/**
 * @param {number} x px
 * @param {number} bottom px
 */
const missingMark = (x, bottom) =>
  svgElement('path', { class: 'missing', d: `M${x - 3} ${bottom - 9}l6 6m0-6l-6 6` });

/**
 * Returns the bar with its error bar and dots, or with its value if it is cut off.
 * @param {Bar} bar
 * @param {number} mean
 * @param {number} left px
 * @param {number} slot px, width for the bar and its gaps
 * @param {Scale} scale
 */
function barShapes({ filter, colour, spread, dots }, mean, left, slot, { top, y }) {
  const [x, width, middle] = [left + 0.06 * slot, 0.88 * slot, left + slot / 2];
  const shape = { ...appearance(filter, colour), x, y: y(mean), width, height: y(0) - y(mean) };
  /** @type {SVGElement[]} */
  const shapes = [svgElement('rect', shape)];
  if (mean > top) return [...shapes, ...cutMarks(mean, x, width, middle, slot)];
  if (spread !== null) {
    const [low, high] = [y(Math.max(0, mean - spread)), y(mean + spread)];
    const cap = Math.min(3, slot / 4);
    const caps = `M${middle - cap} ${low}h${2 * cap}M${middle - cap} ${high}h${2 * cap}`;
    shapes.push(svgElement('path', { class: 'whisker', d: `M${middle} ${low}V${high}${caps}` }));
  }
  const spacing = width / (dots.length + 1);
  dots.forEach(({ value, here }, i) => {
    if (value > top) return;
    const radius = Math.min(here ? scaled(3) : scaled(22) / 10, slot / 5);
    const position = { cx: x + (i + 1) * spacing, cy: y(value), r: radius };
    shapes.push(svgElement('circle', { class: here ? 'dot here' : 'dot', ...position }));
  });
  return shapes;
}

/**
 * @param {number} mean
 * @param {number} x px
 * @param {number} width px
 * @param {number} middle px
 * @param {number} slot px
 */
function cutMarks(mean, x, width, middle, slot) {
  const size = Math.min(scaled(11), slot);
  const half = width / 2 + 1;
  const place = `translate(${middle + 0.36 * size} ${MARGIN.top + scaled(10)}) rotate(-90)`;
  const value = svgElement(
    'text',
    { class: 'over', transform: place, 'text-anchor': 'end' },
    fixed(mean, 1),
  );
  value.style.fontSize = `${size}px`;
  const d = `M${x - 1} ${MARGIN.top + 5}l${half}-4 ${half} 4`;
  return [svgElement('path', { class: 'cut', d }), value];
}

/**
 * Returns the colour and texture of a filter, for a legend.
 * @param {string} filter
 * @param {string} colour its property
 */
export function legendSample(filter, colour) {
  return svgElement(
    'svg',
    { class: 'patch', viewBox: '0 0 14 10', 'aria-hidden': 'true' },
    svgElement('rect', { ...appearance(filter, colour), x: 0.5, y: 0.5, width: 13, height: 9 }),
  );
}

/**
 * Makes the links in a host one tab stop; the arrow keys move between them, up and down by rows of `data-row` links.
 * @param {HTMLElement} host
 */
export function navigateLinks(host) {
  host.addEventListener('keydown', (event) => {
    const links = [...host.querySelectorAll('a')];
    const place = links.findIndex((link) => link === event.target);
    const row = Number(host.dataset.row) || links.length;
    /** @type {Record<string, number>} */
    const targets = {
      ArrowLeft: place - 1,
      ArrowRight: place + 1,
      ArrowUp: place - row,
      ArrowDown: place + row,
      Home: 0,
      End: links.length - 1,
    };
    if (!(event.key in targets) || place < 0) return;
    event.preventDefault();
    event.stopPropagation();
    const target = links[targets[event.key]];
    if (!target) return;
    for (const link of links) link.tabIndex = link === target ? 0 : -1;
    target.focus();
  });
}

/** @param {string} filter */
const texture = (filter) => estimatorOf(filter, Object.keys(TEXTURES));

/**
 * @param {string} filter
 * @param {string} colour
 * @returns {Record<string, string>}
 */
function appearance(filter, colour) {
  const kind = texture(filter);
  return {
    class: 'face',
    style: `--line: var(${colour})`,
    ...(kind ? { fill: `url(#bar${colour}-${kind})` } : {}),
  };
}

/**
 * Returns the textures of filters, which their bars refer to.
 * @param {Bar[]} bars
 */
function textureDefinitions(bars) {
  const textured = bars.filter(({ filter }) => texture(filter));
  const byId = new Map(textured.map((bar) => [`bar${bar.colour}-${texture(bar.filter)}`, bar]));
  const patterns = [...byId].map(([id, { filter, colour }]) =>
    svgElement(
      'pattern',
      {
        id,
        class: 'texture',
        style: `--line: var(${colour})`,
        width: TEXTURE_SIZE,
        height: TEXTURE_SIZE,
        patternUnits: 'userSpaceOnUse',
      },
      svgElement('rect', { width: TEXTURE_SIZE, height: TEXTURE_SIZE }),
      svgElement('path', { d: TEXTURES[texture(filter)] }),
    ),
  );
  return svgElement('defs', {}, ...patterns);
}

/**
 * Returns the largest value of the scale.
 * @param {Bar[]} bars
 * @param {Chart['level']} level
 */
function scaleTop(bars, level) {
  const ends = bars.flatMap(({ mean, spread }) => (mean === null ? [] : [mean + (spread ?? 0)]));
  const means = bars.flatMap(({ mean }) => (mean === null ? [] : [mean])).sort((a, b) => a - b);
  const limit = MAX_HEIGHT * (means[Math.floor(means.length / 2)] ?? 0);
  const top = Math.min(Math.max(0, ...ends), limit) || level?.value || 1;
  return 1.04 * (level && level.value > top && level.value <= 1.3 * top ? level.value : top);
}
