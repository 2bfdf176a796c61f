/** Colours, dashes and the colour table of the maps. The colours themselves are in page.css, for light and dark. */

/** Viridis at 16 even places, from 0 to 1. */
const VIRIDIS = [
  0x440154, 0x481a6c, 0x472f7d, 0x414487, 0x39568c, 0x31688e, 0x2a788e, 0x23888e,
  0x1f988b, 0x22a884, 0x35b779, 0x54c568, 0x7ad151, 0xa5db36, 0xd2e21b, 0xfde725,
];

/** Cividis, matplotlib's, likewise: made for eyes that do not tell red from green. */
const CIVIDIS = [
  0x00224e, 0x002e6c, 0x1e3a6f, 0x35456c, 0x47516c, 0x575d6d, 0x666970, 0x757575,
  0x848279, 0x948e77, 0xa59c74, 0xb7a96e, 0xc8b866, 0xdbc75a, 0xeed649, 0xfee838,
];

const UNIT = parseFloat(getComputedStyle(document.documentElement).fontSize) / 10;

/** What is so many px on most screens, on this one: as `rem` in the style sheets, a tenth of it. */
export const em = (px) => Math.round(px * UNIT);

/** One meaning has one colour and one dash everywhere, so that lines differ without colour too. */
const DASHES = { truth: [], fused: [], image: [7, 3], haptics: [2, 2.5] };
const WIDTHS = { truth: 1.25, fused: 2.25 };
const SPARE_DASHES = [[9, 3, 2, 3], [4, 2], [1, 3]];

/** Blue through white to red at 11 even places, ColorBrewer's: for values on either side of zero. */
const DIVERGING = [
  0x053061, 0x2166ac, 0x4393c3, 0x92c5de, 0xd1e5f0, 0xf7f7f7, 0xfddbc7, 0xf4a582, 0xd6604d, 0xb2182b, 0x67001f,
];

/** @returns {Uint32Array} 256 colours as the bytes R, G, B, A in memory: what ImageData holds. */
function colourTable(stops) {
  const bytes = new Uint8ClampedArray(256 * 4);
  for (let i = 0; i < 256; i++) {
    const place = (i / 255) * (stops.length - 1);
    const low = Math.min(Math.floor(place), stops.length - 2);
    for (let channel = 0; channel < 3; channel++) {
      const shift = 16 - 8 * channel;
      const [a, b] = [(stops[low] >> shift) & 255, (stops[low + 1] >> shift) & 255];
      bytes[4 * i + channel] = a + (b - a) * (place - low);
    }
    bytes[4 * i + 3] = 255;
  }
  return new Uint32Array(bytes.buffer);
}

export const COLOUR_TABLE = colourTable(VIRIDIS);
export const SIGNED_TABLE = colourTable(DIVERGING);

const STOPS = { viridis: VIRIDIS, cividis: CIVIDIS, diverging: DIVERGING };
/** By name, for the maps. */
export const TABLES = { viridis: COLOUR_TABLE, cividis: colourTable(CIVIDIS), diverging: SIGNED_TABLE };

/** A colour table for CSS, from left to right. */
export const gradient = (name) => `linear-gradient(90deg, ${STOPS[name].map((stop) => `#${stop.toString(16).padStart(6, '0')}`).join(', ')})`;

/** @param {string} name of a colour in page.css. @returns {string} as it is now, light or dark. */
export const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`);

let unnamed = []; // modalities that have no colour of their own

/** Gives each modality that is not known here a colour and a dash to spare. @param {string[]} modalities of what is shown */
export const tellApart = (modalities) => (unnamed = modalities.filter((name) => !Object.hasOwn(DASHES, name)));

const spare = (name) => Math.max(0, unnamed.indexOf(name)) % SPARE_DASHES.length;

/** The colour's name in CSS. @param {string} name truth, fused or a modality */
export const variable = (name) => (Object.hasOwn(DASHES, name) ? `--${name}` : `--spare-${spare(name)}`);

/** @param {string} colour `rgb(...)` as the browser gives it. @param {number} alpha 0..1. */
export function translucent(colour, alpha) {
  return `color-mix(in srgb, ${colour} ${100 * alpha}%, transparent)`;
}

/**
 * @param {string} name truth, fused or a modality.
 * @returns {{stroke: string, dash: number[], width: number}} how its line is drawn.
 */
export function line(name) {
  const dash = DASHES[name] ?? SPARE_DASHES[spare(name)];
  return { stroke: colour(variable(name).slice(2)), dash, width: WIDTHS[name] ?? 1.5 };
}

/** A short piece of the line, for legends. @returns {SVGElement} */
export function swatch(name) {
  const { dash, width } = line(name);
  return sample(variable(name), dash, width);
}

/** The same of any line. @param {string} property of the colour in CSS */
export function sample(property, dash, width) {
  const svg = document.createElementNS('http://www.w3.org/2000/svg', 'svg');
  svg.setAttribute('class', 'swatch');
  svg.setAttribute('viewBox', '0 0 20 8');
  svg.setAttribute('aria-hidden', 'true');
  const path = document.createElementNS(svg.namespaceURI, 'path');
  path.setAttribute('d', 'M0 4h20');
  path.setAttribute('stroke-dasharray', dash.join(' '));
  path.setAttribute('stroke-width', String(width));
  path.style.stroke = `var(${property})`;
  svg.append(path);
  return svg;
}

/** Light or dark: the system's, until somebody chooses. */
export class Theme {
  #media = matchMedia('(prefers-color-scheme: dark)');
  #changed;

  /** @param {(dark: boolean) => void} changed */
  constructor(changed) {
    this.#changed = changed;
    const kept = localStorage.getItem('beliefscope.theme');
    if (kept === 'light' || kept === 'dark') document.documentElement.dataset.theme = kept;
    this.#media.addEventListener('change', () => changed(this.dark));
  }

  get dark() {
    const chosen = document.documentElement.dataset.theme;
    return chosen ? chosen === 'dark' : this.#media.matches;
  }

  toggle() {
    const theme = this.dark ? 'light' : 'dark';
    document.documentElement.dataset.theme = theme;
    localStorage.setItem('beliefscope.theme', theme);
    this.#changed(this.dark);
  }
}
