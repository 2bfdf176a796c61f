/** The legend below exported maps: the marks that are drawn on them. */

/** @import { Context } from './draw_map.js' */
/** @import { DisplayedMaps } from './map_panel.js' */

import { lineStyle } from '../core/colours.js';
import { isCurve } from './map_values.js';

export const ROW = 16; // px, height of a row
const SAMPLE = 16; // px from the centre of a sample to its text
const CHARACTER = 5.5; // px, of a text of 10 px
const GAP = 14; // px between entries
const [SIZE, LEG] = [5, 2]; // px, half the size of a sample, and of a corner
const FAINT = '#999';
const DIRECTIONS = [
  [1, 0],
  [0, 1],
  [-1, 0],
  [0, -1],
];

/**
 * @typedef {(x: number, y: number, context: Context) => void} Path of a sample around its centre
 * @typedef {object} Entry
 * @property {string} text
 * @property {string} colour
 * @property {Path} path
 * @property {number[]} [dash]
 */

/** @type {Path} */
const cross = (x, y, context) => {
  for (const [dx, dy] of DIRECTIONS) {
    context.moveTo(x + LEG * dx, y + LEG * dy);
    context.lineTo(x + SIZE * dx, y + SIZE * dy);
  }
};
/** @type {Path} */
const circle = (x, y, context) => context.arc(x, y, SIZE - 1, 0, 2 * Math.PI);
/** @type {Path} */
const diamond = (x, y, context) => {
  context.moveTo(x, y - SIZE);
  for (const [dx, dy] of DIRECTIONS) context.lineTo(x + SIZE * dx, y + SIZE * dy);
  context.lineTo(x, y - SIZE);
};
/** @type {Path} */
const brackets = (x, y, context) => {
  for (const side of [-SIZE + 1, SIZE - 1]) {
    context.moveTo(x + side / 2, y - SIZE + 1);
    context.lineTo(x + side, y - SIZE + 1);
    context.lineTo(x + side, y + SIZE - 1);
    context.lineTo(x + side / 2, y + SIZE - 1);
  }
};
/** @type {Path} */
const line = (x, y, context) => {
  context.moveTo(x - SIZE - LEG, y);
  context.lineTo(x + SIZE + LEG, y);
};

/** @type {Path} */
const axis = (x, y, context) => {
  for (const end of [-1, 1]) {
    context.moveTo(x, y);
    context.lineTo(x + SIZE * end, y);
    context.moveTo(x + SIZE * end, y - LEG);
    context.lineTo(x + SIZE * end, y + LEG);
  }
};

/**
 * Returns the marks on maps, in rows that fit a width.
 * @param {DisplayedMaps[]} sheets
 * @param {string} ink colour of marks that are white on the maps
 * @param {number} width px
 * @returns {Entry[][]}
 */
export function legendRows(sheets, ink, width) {
  /** @type {Entry[][]} */
  const rows = [[]];
  let used = 0;
  for (const entry of entries(sheets, ink)) {
    const size = entryWidth(entry);
    if (used && used + size > width) {
      rows.push([]);
      used = 0;
    }
    rows[rows.length - 1].push(entry);
    used += size;
  }
  return rows;
}

/** @param {Entry} entry */
const entryWidth = ({ text }) => SAMPLE + CHARACTER * text.length + GAP;

/**
 * @param {DisplayedMaps[]} sheets
 * @param {string} ink
 * @returns {Entry[]}
 */
function entries(sheets, ink) {
  const [{ trace, maps, layers }] = sheets;
  const curve = isCurve(maps);
  /** @param {(sheet: DisplayedMaps) => unknown} test */
  const some = (test) => sheets.some(test);
  /** @param {string} shape */
  const hasShape = (shape) =>
    some((sheet) => sheet.layers.some(({ index }) => sheet.maps.shape[index] === shape));
  const inContact = sheets.filter((sheet) => trace.contact[sheet.maps.step]);
  const borders = some((sheet) => sheet.layers.some((layer) => layer.borders.length > 0));
  /** @type {[shown: unknown, text: string, colour: string, path: Path, dash?: number[]][]} */
  const marks = [
    [
      some((sheet) => sheet.maps.truth[sheet.maps.axes[0].index] !== null),
      'truth',
      curve ? lineStyle('truth').stroke : ink,
      curve ? line : cross,
    ],
    ...layers
      .filter(({ name }) => name !== 'fused' && trace.fuses)
      .map(
        ({ name }) =>
          /** @type {[boolean, string, string, Path, number[]]} */ ([
            true,
            trace.label(name),
            lineStyle(name).stroke,
            curve ? line : circle,
            curve ? [2, 3] : [],
          ]),
      ),
    [
      true,
      trace.label('fused'),
      lineStyle('fused').stroke,
      curve ? line : diamond,
      curve ? [5, 3] : [],
    ],
    [!curve && inContact.some((sheet) => sheet.maps.effector), 'end effector', ink, brackets],
    [
      !curve && inContact.some((sheet) => sheet.maps.expected !== null),
      'expected ridge',
      ink,
      line,
      [3, 2],
    ],
    [!curve && hasShape('ridge'), 'long axis of a ridge', ink, axis],
    [!curve && hasShape('ring'), 'ring', ink, circle, [3, 1.5]],
    [!curve && borders, '50 % region', ink, line],
    [!curve && borders, '95 % region', FAINT, line],
  ];
  return marks.flatMap(([shown, text, colour, path, dash]) =>
    shown ? [{ text, colour, path, dash }] : [],
  );
}

/**
 * Draws a legend.
 * @param {Context} context with the font and colour of texts
 * @param {Entry[][]} rows
 * @param {number} left px
 * @param {number} top px, of the first row's middle
 */
export function drawLegend(context, rows, left, top) {
  rows.forEach((row, i) => {
    let x = left + SIZE + LEG;
    for (const entry of row) {
      const y = top + i * ROW;
      context.setLineDash(entry.dash ?? []);
      [context.strokeStyle, context.lineWidth] = [entry.colour, 1.5];
      context.beginPath();
      entry.path(x, y, context);
      context.stroke();
      context.setLineDash([]);
      [context.textAlign, context.textBaseline] = ['left', 'middle'];
      context.fillText(entry.text, x + SAMPLE - SIZE, y);
      x += entryWidth(entry);
    }
  });
}
