/** Exports of the likelihood maps: images (PNG, SVG) and tables (CSV), made in the browser. */

/** @import { Context, Layer } from './draw_map.js' */
/** @import { DisplayedMaps } from './map_panel.js' */

import { context2d, create, element, html, messageOf } from '../core/dom.js';
import { COLOUR_TABLES } from '../core/palette.js';
import { fixed, sentence } from '../core/units.js';
import { drawCurve } from './draw_curve.js';
import { MARGIN, drawMap } from './draw_map.js';
import { mapTitle } from './map_summary.js';
import { isCurve, logLikelihood, rangeDigits, rangeLabels } from './map_values.js';
import { SvgContext } from './svg_context.js';

const SIDE = 300; // px of a map's square
const SHEET = { padding: 14, title: 24, bar: 8, footer: 40, pixelRatio: 2 };
const INK = '#222';
const LEFT = MARGIN.left + MARGIN.name;
const COLUMN = SIDE + LEFT + MARGIN.right;

/** @type {Record<string, (sheet: DisplayedMaps, name: string) => Promise<string> | string>} */
const ACTIONS = {
  png: async (sheet, name) => download(await png(sheet), `${name}.png`),
  svg: (sheet, name) => download(new Blob([svg(sheet)], { type: 'image/svg+xml' }), `${name}.svg`),
  csv: (sheet, name) => download(new Blob([csv(sheet)], { type: 'text/csv' }), `${name}.csv`),
  copy: async (sheet) => {
    await navigator.clipboard.write([new ClipboardItem({ 'image/png': png(sheet) })]);
    return 'Image copied.';
  },
};

/**
 * Connects the buttons of the export.
 * @param {HTMLElement} host
 * @param {() => DisplayedMaps | null} displayed
 * @returns {(layers: string[]) => void} sets the layers to choose from
 */
export function bindExport(host, displayed) {
  const select = element('select', HTMLSelectElement, host);
  const output = html('output', host);
  host.addEventListener('click', async ({ target }) => {
    const action = target instanceof HTMLElement && ACTIONS[target.dataset.as ?? ''];
    const sheet = displayed();
    if (!action || !sheet) return;
    const selected = sheet.layers.filter(({ name }) => name === select.value);
    const layers = selected.length ? selected : sheet.layers;
    try {
      output.textContent = await action({ ...sheet, layers }, fileName(sheet, select.value));
    } catch (error) {
      output.textContent = sentence(`Export failed: ${messageOf(error)}`);
    }
  });
  return (layers) => {
    const { value } = select;
    select.replaceChildren(new Option('all maps', ''), ...layers.map((name) => new Option(name)));
    select.value = layers.includes(value) ? value : '';
    output.textContent = '';
  };
}

/**
 * @param {DisplayedMaps} sheet
 * @param {string} layer
 */
function fileName({ trace, maps }, layer) {
  const { task, filter, episode } = trace.selection;
  return [task, filter, `episode${episode}`, `step${maps.step}`, layer || 'maps']
    .concat(maps.quantity === 'likelihood' ? [] : maps.quantity)
    .join('-')
    .replaceAll(/[^\w.-]+/g, '-');
}

/** @param {DisplayedMaps} sheet */
function caption({ trace, maps }) {
  const { task, filter, data, episode, faults } = trace.selection;
  const off = trace.components.findIndex((_, i) => maps.axes.every(({ index }) => index !== i));
  const { unit, scale } = off < 0 ? { unit: '', scale: 1 } : trace.unitOf(off);
  const angle =
    maps.angle === null ? '' : `, cross-section at ${fixed(maps.angle * scale, 1)}${unit}`;
  return `${task}, ${filter}, ${data} episode ${episode}, ${faults ? `faults ${faults}, ` : ''}step ${maps.step}${angle}`;
}

/**
 * Writes a table with one row per cell.
 * @param {DisplayedMaps} sheet
 */
export function csv(sheet) {
  const { maps, layers } = sheet;
  const logs = layers.map(({ index }) => logLikelihood(maps, index));
  const { size, rows: height, axes, centre } = maps;
  /** @param {number} index @param {number} axis */
  const offset = (index, axis) => (((index + 0.5) / size) * 2 - 1) * axes[axis].half_width;
  const lowest = layers.map(
    ({ name, index }) => `${name} ${fixed(maps.log_max[index] - maps.log_range[index], 3)}`,
  );
  const comments = [
    `# Beliefscope: ${caption(sheet)}: natural logarithm. ${mapTitle(maps)}`,
    `# offset: from the true value. Values are clipped at: ${lowest.join(' / ')}`,
  ];
  const names = layers.map(({ name }) => `${name}_ln_${maps.quantity}_nats`);
  const rows = [
    ...comments.map((line) => line.replaceAll('−', '-')),
    [
      ...axes.map(({ name, shown }) => columnName(`${name}_offset`, shown)),
      ...axes.map(({ name, shown }) => columnName(name, shown)),
      ...names,
    ].join(','),
  ];
  for (let i = 0; i < size * height; i++) {
    const offsets = axes.map((_, axis) => offset(axis ? Math.floor(i / size) : i % size, axis));
    const positions = [...offsets, ...offsets.map((d, axis) => d + centre[axis])];
    const numbers = positions.map((value, k) => (value * axes[k % axes.length].scale).toFixed(3));
    rows.push([...numbers, ...logs.map((values) => values[i].toFixed(4))].join(','));
  }
  return `${rows.join('\n')}\n`;
}

/**
 * @param {string} name
 * @param {string} unit
 */
const columnName = (name, unit) => (unit ? `${name}_${unit}` : name);

/** @param {DisplayedMaps} sheet */
function svg(sheet) {
  const context = new SvgContext();
  const [width, height] = sheetSize(sheet);
  drawSheet(context, sheet, width, height);
  return context.document(width, height);
}

/**
 * @param {DisplayedMaps} sheet
 * @returns {Promise<Blob>}
 */
async function png(sheet) {
  const [width, height] = sheetSize(sheet);
  const { pixelRatio } = SHEET;
  const canvas = create('canvas', { width: pixelRatio * width, height: pixelRatio * height });
  const context = context2d(canvas);
  context.scale(pixelRatio, pixelRatio);
  drawSheet(context, sheet, width, height);
  return new Promise((resolve, reject) => {
    canvas.toBlob(
      (blob) => (blob ? resolve(blob) : reject(new Error('the image is too large'))),
      'image/png',
    );
  });
}

/** @param {DisplayedMaps} sheet */
function sheetSize({ layers }) {
  const { padding, title, footer } = SHEET;
  return [
    2 * padding + layers.length * COLUMN,
    padding + title + SIDE + MARGIN.bottom + MARGIN.name + footer + padding,
  ];
}

/**
 * @param {Context} context
 * @param {DisplayedMaps} sheet
 * @param {number} width
 * @param {number} height
 */
function drawSheet(context, sheet, width, height) {
  const { padding, title } = SHEET;
  context.fillStyle = '#fff';
  context.beginPath();
  context.rect(0, 0, width, height);
  context.fill();
  sheet.layers.forEach((layer, i) => {
    context.save();
    context.translate(padding + i * COLUMN + LEFT, padding + title);
    context.fillStyle = INK;
    context.font = '600 13px system-ui, sans-serif';
    [context.textAlign, context.textBaseline] = ['left', 'alphabetic'];
    context.fillText(`${layer.name} ${sheet.maps.quantity}`, 0, -8);
    if (!isCurve(sheet.maps)) drawColourBar(context, layer);
    const options = { ...sheet.options, textColour: INK, withY: true, named: true, hover: null };
    const draw = isCurve(sheet.maps) ? drawCurve : drawMap;
    draw(context, layer, SIDE, options);
    context.restore();
  });
  context.fillStyle = INK;
  context.font = '10px system-ui, sans-serif';
  [context.textAlign, context.textBaseline] = ['left', 'alphabetic'];
  context.fillText(caption(sheet), padding, height - padding - 12);
  context.fillText(`${mapTitle(sheet.maps)}. Colour: ${sheet.title}`, padding, height - padding);
}

/**
 * Draws the colour bar above the right end of a map.
 * @param {Context} context
 * @param {Layer} layer
 */
function drawColourBar(context, { shade, colourMap }) {
  const canvas = create('canvas', { width: 256, height: 1 });
  const image = new ImageData(256, 1);
  new Uint32Array(image.data.buffer).set(COLOUR_TABLES[colourMap]);
  context2d(canvas).putImageData(image, 0, 0);
  const [low, high] = rangeLabels(shade, rangeDigits(shade));
  context.font = '10px system-ui, sans-serif';
  context.drawImage(canvas, SIDE - 130, -8 - SHEET.bar, 90, SHEET.bar);
  context.textAlign = 'right';
  context.fillText(low, SIDE - 134, -8);
  context.textAlign = 'left';
  context.fillText(high, SIDE - 36, -8);
}

/**
 * @param {Blob} blob
 * @param {string} name
 */
function download(blob, name) {
  const link = create('a', { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  return 'Saved.';
}
