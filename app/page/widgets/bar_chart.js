/** Grouped bars with whiskers and dots, drawn as SVG whose bars are links; the looks of filters, for the bars and their legend. */

import { scaled } from '../core/palette.js';
import { fixed } from '../core/units.js';

const SVG = 'http://www.w3.org/2000/svg';
/** As in the paper's figure (recordings/rerun_log/figures.py): a colour for what a filter fuses, a texture for how it filters. */
const FAMILIES = {
  crossmodal: '--fused',
  unimodal: '--spare-2',
  feature: '--spare-1',
  lstm: '--spare-0',
  image: '--image',
  haptics: '--haptics',
};
const TEXTURES = { pf: 'M-1 5 5-1M1 7 7 1', ukf: 'M1 2h2M4 5h2', lstm: 'M0 1.5h6M0 4.5h6' };
const PATTERN = 6; // px, side of a texture's square
const EDGE = { left: scaled(34), right: scaled(6), top: scaled(16), bottom: scaled(22) }; // px
const TALLEST = 2.5; // times the bar in the middle: taller ones are cut off and say their value
const SHARE = 0.86; // of a group that is bars
const LINES = 5; // of the scale, about

/**
 * @typedef {object} Bar
 * @property {string} filter @property {number | null} mean @property {number | null} spread
 * @property {{value: number, here: boolean}[]} dots one a seed; whether it is the one that a link opens
 * @property {string | null} href null where there is nothing to open @property {string} label all of it in words
 * @typedef {object} Chart
 * @property {string} label @property {string} unit of the scale @property {{name: string, bars: Bar[]}[]} groups
 * @property {{name: string, value: number} | null} level a dashed line
 */

export class Bars {
  #host;
  #chart = null;
  #told;
  #width = 0;

  /** @param {HTMLElement} host @param {(bar: Bar | null) => void} told which bar is looked at */
  constructor(host, told) {
    [this.#host, this.#told] = [host, told];
    new ResizeObserver(() => host.clientWidth !== this.#width && this.#draw()).observe(host);
    roam(host);
    const look = ({ target }) => this.#told(target.closest?.('a')?.bar ?? null);
    for (const kind of ['pointerover', 'focusin']) host.addEventListener(kind, look);
    for (const kind of ['pointerleave', 'focusout'])
      host.addEventListener(kind, () => this.#told(null));
  }

  /** @param {Chart | null} chart */
  show(chart) {
    this.#chart = chart;
    this.#draw();
  }

  /** Marks the bars of one filter; of none for an empty name. */
  mark(filter) {
    for (const link of this.#host.querySelectorAll('a'))
      link.classList.toggle('here', link.bar.filter === filter);
  }

  #draw() {
    const [width, height] = [(this.#width = this.#host.clientWidth), this.#host.clientHeight];
    const focused = [...this.#host.querySelectorAll('a')].indexOf(document.activeElement);
    this.#host.replaceChildren();
    if (!this.#chart || !width) return;
    const { label, unit, groups, level } = this.#chart;
    const bars = groups.flatMap((group) => group.bars);
    const top = highest(bars, level);
    const y = (value) =>
      EDGE.top + (height - EDGE.top - EDGE.bottom) * (1 - Math.min(value, top) / top);
    const across = (width - EDGE.left - EDGE.right) / groups.length;
    const svg = element(
      'svg',
      { viewBox: `0 0 ${width} ${height}`, width, height, role: 'group', 'aria-label': label },
      textures(bars.map((bar) => bar.filter)),
    );
    const step = pleasing(top / LINES);
    for (let value = 0; value <= top; value += step) {
      svg.append(
        element('path', {
          class: value ? 'grid' : 'ground',
          d: `M${EDGE.left} ${y(value)}H${width - EDGE.right}`,
        }),
      );
      svg.append(
        element(
          'text',
          { x: EDGE.left - 5, y: y(value) + scaled(4), 'text-anchor': 'end' },
          fixed(value, step < 0.1 ? 2 : step < 1 ? 1 : 0),
        ),
      );
    }
    svg.append(element('text', { x: 2, y: scaled(10) }, unit));
    groups.forEach((group, g) => {
      const left = EDGE.left + g * across + ((1 - SHARE) / 2) * across;
      const each = (SHARE * across) / group.bars.length;
      svg.append(
        element(
          'text',
          { x: left + (SHARE * across) / 2, y: height - scaled(7), 'text-anchor': 'middle' },
          group.name,
        ),
      );
      group.bars.forEach((bar, i) => svg.append(this.#bar(bar, left + i * each, each, y, top)));
    });
    if (level && level.value <= top) {
      svg.append(
        element('path', {
          class: 'level',
          d: `M${EDGE.left} ${y(level.value)}H${width - EDGE.right}`,
        }),
      );
      svg.append(
        element(
          'text',
          { x: width - EDGE.right, y: y(level.value) - 4, 'text-anchor': 'end' },
          level.name,
        ),
      );
    }
    this.#host.append(svg);
    const links = [...svg.querySelectorAll('a')];
    links.forEach((link, i) => (link.tabIndex = i === Math.max(0, focused) ? 0 : -1));
    if (focused >= 0) links[focused]?.focus();
  }

  #bar(bar, left, each, y, top) {
    const [x, wide, middle] = [left + 0.06 * each, 0.88 * each, left + each / 2];
    const link = element('a', {
      class: 'bar-link',
      'aria-label': bar.label,
      ...(bar.href === null ? { role: 'img' } : { href: bar.href }),
    });
    link.bar = bar;
    link.append(
      element('rect', {
        class: 'hit',
        x: left,
        y: EDGE.top - 4,
        width: each,
        height: y(0) - EDGE.top + 4,
      }),
    );
    if (bar.mean === null) {
      link.append(
        element('path', { class: 'missing', d: `M${middle - 3} ${y(0) - 9}l6 6m0-6l-6 6` }),
      );
      return link;
    }
    link.append(
      element('rect', {
        ...face(bar.filter),
        x,
        y: y(bar.mean),
        width: wide,
        height: y(0) - y(bar.mean),
      }),
    );
    if (bar.mean > top) {
      link.append(
        element('path', {
          class: 'cut',
          d: `M${x - 1} ${EDGE.top + 5}l${wide / 2 + 1}-4 ${wide / 2 + 1} 4`,
        }),
      );
      const size = Math.min(scaled(11), each);
      const text = {
        class: 'over',
        transform: `translate(${middle + 0.36 * size} ${EDGE.top + scaled(10)}) rotate(-90)`,
        'text-anchor': 'end',
      };
      const told = element('text', text, fixed(bar.mean, 1));
      told.style.fontSize = `${size}px`;
      link.append(told);
      return link;
    }
    if (bar.spread !== null) {
      const [from, to] = [y(Math.max(0, bar.mean - bar.spread)), y(bar.mean + bar.spread)];
      const cap = Math.min(3, each / 4);
      link.append(
        element('path', {
          class: 'whisker',
          d: `M${middle} ${from}V${to}M${middle - cap} ${from}h${2 * cap}M${middle - cap} ${to}h${2 * cap}`,
        }),
      );
    }
    const apart = wide / (bar.dots.length + 1);
    bar.dots.forEach(({ value, here }, i) => {
      const dot = {
        class: here ? 'dot here' : 'dot',
        cx: x + (i + 1) * apart,
        cy: y(value),
        r: Math.min(here ? scaled(3) : scaled(22) / 10, each / 5),
      };
      if (value <= top) link.append(element('circle', dot));
    });
    return link;
  }
}

/** A piece of a filter's bar, for a legend. @param {string} filter */
export function patch(filter) {
  return element(
    'svg',
    { class: 'patch', viewBox: '0 0 14 10', 'aria-hidden': 'true' },
    element('rect', { ...face(filter), x: 0.5, y: 0.5, width: 13, height: 9 }),
  );
}

/**
 * Makes the links in a host one stop of the tab key: the arrows go from one to the next, up and down by rows of as many as
 * `data-row` of the host says.
 * @param {HTMLElement} host
 */
export function roam(host) {
  host.addEventListener('keydown', (event) => {
    const links = [...host.querySelectorAll('a')];
    const place = links.indexOf(event.target);
    const row = Number(host.dataset.row) || links.length;
    const by = {
      ArrowLeft: -1,
      ArrowRight: 1,
      ArrowUp: -row,
      ArrowDown: row,
      Home: -Infinity,
      End: Infinity,
    }[event.key];
    if (by === undefined || place < 0) return;
    event.preventDefault();
    event.stopPropagation();
    const to = Number.isFinite(by) ? place + by : by < 0 ? 0 : links.length - 1;
    if (!links[to]) return;
    links.forEach((link, i) => (link.tabIndex = i === to ? 0 : -1));
    links[to].focus();
  });
}

const family = (filter) => filter.replace(/-?(ekf|ukf|pf)$/, '');
const texture = (filter) =>
  Object.keys(TEXTURES).find((kind) => `-${filter}`.endsWith(`-${kind}`)) ?? '';
const hue = (filter) => FAMILIES[family(filter)] ?? '--ink';

function face(filter) {
  const kind = texture(filter);
  return {
    class: 'face',
    style: `--line: var(${hue(filter)})`,
    ...(kind ? { fill: `url(#bar${hue(filter)}-${kind})` } : {}),
  };
}

/** The textures of these filters, to be named by their bars. */
function textures(filters) {
  const kinds = new Map(
    filters.filter(texture).map((filter) => [`bar${hue(filter)}-${texture(filter)}`, filter]),
  );
  const made = [...kinds].map(([id, filter]) =>
    element(
      'pattern',
      {
        id,
        class: 'texture',
        style: `--line: var(${hue(filter)})`,
        width: PATTERN,
        height: PATTERN,
        patternUnits: 'userSpaceOnUse',
      },
      element('rect', { width: PATTERN, height: PATTERN }),
      element('path', { d: TEXTURES[texture(filter)] }),
    ),
  );
  return element('defs', {}, ...made);
}

/** Where the scale ends. */
function highest(bars, level) {
  const means = bars
    .map((bar) => bar.mean)
    .filter((mean) => mean !== null)
    .sort((a, b) => a - b);
  const whole = Math.max(
    0,
    ...bars.filter((bar) => bar.mean !== null).map((bar) => bar.mean + (bar.spread ?? 0)),
  );
  const cut = TALLEST * (means[Math.floor(means.length / 2)] ?? 0);
  const top = Math.min(whole, cut) || level?.value || 1;
  return 1.04 * (level && level.value > top && level.value <= 1.3 * top ? level.value : top);
}

/** 1, 2 or 5 times a power of ten, no less than a value. */
function pleasing(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * ([1, 2, 5].find((times) => times * power >= value) ?? 10);
}

function element(tag, attributes, ...children) {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes))
    made.setAttribute(name, typeof value === 'number' ? Number(value.toFixed(2)) : value);
  made.append(...children);
  return made;
}
