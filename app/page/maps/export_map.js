/** Exports of the likelihood maps: images (PNG, SVG) and tables (CSV), made in the browser. */

/** @import { Context, Layer } from './draw_map.js' */
/** @import { DisplayedMaps } from './map_panel.js' */

import { context2d, create, element, html, messageOf, paintPixels } from '../core/dom.js';
import { COLOUR_TABLES } from '../core/colours.js';
import { download } from '../core/download.js';
import { columnName, fixed, sentence } from '../core/units.js';
import { drawCurve } from './draw_curve.js';
import { MARGIN, drawMap } from './draw_map.js';
import { ROW, drawLegend, legendRows } from './export_legend.js';
import { mapTitle } from './map_summary.js';
import { isCurve, logLikelihood, rangeDigits, rangeLabels } from './map_values.js';
import { SvgContext } from './svg_context.js';

const SIDE = 300; // px of a map's square
const SHEET = { padding: 14, title: 24, bar: 8, footer: 40, pixelRatio: 2 };
const INK = '#222';
const [TEXT, TITLE] = ['10px system-ui, sans-serif', '600 13px system-ui, sans-serif'];
const LEFT = MARGIN.left + MARGIN.name;
const COLUMN = SIDE + LEFT + MARGIN.right;
const TILE = { side: 140, gap: 8, names: 70, head: 36 }; // px, of a sheet with several steps

/** Exports of the displayed steps. @type {Record<string, (sheets: DisplayedMaps[], name: string) => Promise<string> | string>} */
const ACTIONS = {
  png: async (sheets, name) => save(await png(sheets), `${name}.png`),
  svg: (sheets, name) => save(new Blob([svg(sheets)], { type: 'image/svg+xml' }), `${name}.svg`),
  csv: (sheets, name) => save(new Blob([csv(sheets)], { type: 'text/csv' }), `${name}.csv`),
  copy: async (sheets) => {
    await navigator.clipboard.write([new ClipboardItem({ 'image/png': png(sheets) })]);
    return 'Image copied.';
  },
};

/**
 * Connects the buttons of the export.
 * @param {HTMLElement} host
 * @param {() => DisplayedMaps[]} displayed maps of each displayed step
 * @returns {(layers: string[]) => void} sets the layers to choose from
 */
export function bindExport(host, displayed) {
  const select = element('select', HTMLSelectElement, host);
  const output = html('output', host);
  host.addEventListener('click', async ({ target }) => {
    const action = target instanceof HTMLElement && ACTIONS[target.dataset.as ?? ''];
    const sheets = displayed();
    if (!action || !sheets.length) return;
    const selected = sheets.map((sheet) => {
      const layers = sheet.layers.filter(({ name }) => name === select.value);
      return layers.length ? { ...sheet, layers } : sheet;
    });
    try {
      output.textContent = await action(selected, fileName(sheets, select.value));
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
 * @param {DisplayedMaps[]} sheets
 * @param {string} layer
 */
function fileName(sheets, layer) {
  const [{ trace, maps }] = sheets;
  const { task, filter, episode } = trace.selection;
  const steps = `step${sheets.length > 1 ? 's' : ''}${sheets.map((sheet) => sheet.maps.step).join('-')}`;
  return [task, filter, `episode${episode}`, steps, layer || 'maps']
    .concat(maps.quantity === 'likelihood' ? [] : maps.quantity)
    .join('-')
    .replaceAll(/[^\w.-]+/g, '-');
}

/** @param {DisplayedMaps[]} sheets */
function caption(sheets) {
  const [{ trace, maps }] = sheets;
  const { task, filter, data, episode, faults } = trace.selection;
  const off = trace.components.findIndex((_, i) => maps.axes.every(({ index }) => index !== i));
  const { unit, scale } = off < 0 ? { unit: '', scale: 1 } : trace.unitOf(off);
  const angle =
    maps.angle === null ? '' : `, cross-section at ${fixed(maps.angle * scale, 1)}${unit}`;
  const steps = sheets.map(({ maps: { step } }) => trace.stepLabel(step).slice(5)).join(', ');
  const named = `${sheets.length > 1 ? 'steps' : 'step'} ${steps}`;
  return `${task}, ${filter}, ${data} episode ${episode}, ${faults ? `faults ${faults}, ` : ''}${named}${angle}`;
}

/**
 * Writes a table with one row per cell. With several steps, the first columns are the step and its timestamp, if any.
 * @param {DisplayedMaps[]} sheets
 */
export function csv(sheets) {
  const [{ trace, maps, layers }] = sheets;
  const several = sheets.length > 1;
  const lowest = sheets.map(({ maps: { step, log_max: max, log_range: range }, layers: drawn }) => {
    const values = drawn.map(({ name, index }) => `${name} ${fixed(max[index] - range[index], 3)}`);
    return `${several ? `step ${step}: ` : ''}${values.join(' / ')}`;
  });
  const comments = [
    `# Beliefscope: ${caption(sheets)}: natural logarithm. ${mapTitle(maps)}`,
    `# offset: from the true value. Values are clipped at: ${lowest.join('; ')}`,
  ];
  const columns = [
    ...(several ? ['step', ...(trace.timestamp(maps.step) === null ? [] : ['time_s'])] : []),
    ...maps.axes.map(({ name, display_unit: unit }) => columnName(`${name}_offset`, unit)),
    ...maps.axes.map(({ name, display_unit: unit }) => columnName(name, unit)),
    ...layers.map(({ name }) => `${name}_ln_${maps.quantity}_nats`),
  ];
  const rows = sheets.flatMap((sheet) => {
    const { step } = sheet.maps;
    const time = trace.timestamp(step);
    const start = `${step},${time === null ? '' : `${time.toFixed(4)},`}`;
    return csvRows(sheet).map((row) => (several ? start : '') + row);
  });
  const head = [...comments.map((line) => line.replaceAll('−', '-')), columns.join(',')];
  return `${[...head, ...rows].join('\n')}\n`;
}

/** @param {DisplayedMaps} sheet */
function csvRows({ maps, layers }) {
  const logs = layers.map(({ index }) => logLikelihood(maps, index));
  const { size, rows: height, axes, centre } = maps;
  /** @param {number} index @param {number} axis */
  const offset = (index, axis) => (((index + 0.5) / size) * 2 - 1) * axes[axis].half_width;
  return Array.from({ length: size * height }, (_, i) => {
    const offsets = axes.map((__, axis) => offset(axis ? Math.floor(i / size) : i % size, axis));
    const positions = [...offsets, ...offsets.map((d, axis) => d + centre[axis])];
    const numbers = positions.map((value, k) => (value * axes[k % axes.length].scale).toFixed(3));
    return [...numbers, ...logs.map((values) => values[i].toFixed(4))].join(',');
  });
}

/** @param {DisplayedMaps[]} sheets */
function svg(sheets) {
  const context = new SvgContext();
  const [width, height] = sheetSize(sheets);
  drawSheet(context, sheets, width, height);
  return context.document(width, height);
}

/**
 * @param {DisplayedMaps[]} sheets
 * @returns {Promise<Blob>}
 */
async function png(sheets) {
  const [width, height] = sheetSize(sheets);
  const { pixelRatio } = SHEET;
  const canvas = create('canvas', { width: pixelRatio * width, height: pixelRatio * height });
  const context = context2d(canvas);
  context.scale(pixelRatio, pixelRatio);
  drawSheet(context, sheets, width, height);
  return new Promise((resolve, reject) => {
    canvas.toBlob(
      (blob) => (blob ? resolve(blob) : reject(new Error('the image is too large'))),
      'image/png',
    );
  });
}

/** @param {DisplayedMaps[]} sheets */
function sheetSize(sheets) {
  const { padding, title } = SHEET;
  const { length } = sheets[0].layers;
  const footer = SHEET.footer + ROW * legend(sheets).length;
  if (sheets.length > 1) {
    const pitch = TILE.side + TILE.gap;
    const left = TILE.names + MARGIN.left;
    return [
      2 * padding + left + sheets.length * pitch,
      2 * padding + TILE.head + length * (pitch + MARGIN.bottom) + footer,
    ];
  }
  return [
    2 * padding + length * COLUMN,
    padding + title + SIDE + MARGIN.bottom + MARGIN.name + footer + padding,
  ];
}

/** @param {DisplayedMaps[]} sheets */
function legend(sheets) {
  const { length } = sheets.length > 1 ? sheets : sheets[0].layers;
  const width = sheets.length > 1 ? TILE.names + length * TILE.side : length * COLUMN;
  return legendRows(sheets, INK, width);
}

/**
 * @param {Context} context
 * @param {DisplayedMaps[]} sheets
 * @param {number} width
 * @param {number} height
 */
function drawSheet(context, sheets, width, height) {
  const { padding } = SHEET;
  context.fillStyle = '#fff';
  context.beginPath();
  context.rect(0, 0, width, height);
  context.fill();
  if (sheets.length > 1) drawSteps(context, sheets);
  else drawStep(context, sheets[0]);
  const [{ maps, title }] = sheets;
  const rows = legend(sheets);
  [context.font, context.fillStyle] = [TEXT, INK];
  drawLegend(context, rows, padding, height - padding - 16 - ROW * rows.length);
  write(context, caption(sheets), padding, height - padding - 12);
  write(context, `${mapTitle(maps)}. Colour: ${title}`, padding, height - padding);
}

/**
 * Draws the maps of one step side by side.
 * @param {Context} context
 * @param {DisplayedMaps} sheet
 */
function drawStep(context, sheet) {
  const { padding, title } = SHEET;
  sheet.layers.forEach((layer, i) => {
    context.save();
    context.translate(padding + i * COLUMN + LEFT, padding + title);
    write(context, `${layer.name} ${sheet.maps.quantity}`, 0, -8, TITLE);
    if (!isCurve(sheet.maps)) drawColourBar(context, layer);
    const options = { ...sheet.options, textColour: INK, withY: true, named: true, hover: null };
    const draw = isCurve(sheet.maps) ? drawCurve : drawMap;
    draw(context, layer, SIDE, options);
    context.restore();
  });
}

/**
 * Draws a column of maps for each step.
 * @param {Context} context
 * @param {DisplayedMaps[]} sheets
 */
function drawSteps(context, sheets) {
  const { side, gap, names, head } = TILE;
  context.translate(SHEET.padding, SHEET.padding);
  sheets.forEach(({ maps, layers, options, phase }, column) => {
    const x = names + MARGIN.left + column * (side + gap);
    write(context, `step ${maps.step}`, x, 12, TITLE);
    write(context, phase ?? '', x, 26);
    layers.forEach((layer, row) => {
      const y = head + row * (side + gap + MARGIN.bottom);
      if (!column) write(context, layer.name, 0, y + 12, TITLE);
      context.save();
      context.translate(x, y);
      const style = { ...options, textColour: INK, withY: !column, named: false, hover: null };
      drawMap(context, layer, side, style);
      context.restore();
    });
  });
  context.translate(-SHEET.padding, -SHEET.padding);
}

/**
 * Draws the colour bar above the right end of a map.
 * @param {Context} context
 * @param {Layer} layer
 */
function drawColourBar(context, { shade, colourMap }) {
  const canvas = create('canvas', { width: 256, height: 1 });
  paintPixels(canvas, COLOUR_TABLES[colourMap]);
  const [low, high] = rangeLabels(shade, rangeDigits(shade));
  context.drawImage(canvas, SIDE - 130, -8 - SHEET.bar, 90, SHEET.bar);
  write(context, low, SIDE - 134, -8, TEXT, 'right');
  write(context, high, SIDE - 36, -8);
}

/**
 * @param {Context} context
 * @param {string} text
 * @param {number} x
 * @param {number} y
 * @param {string} [font]
 * @param {CanvasTextAlign} [align]
 */
function write(context, text, x, y, font = TEXT, align = 'left') {
  context.fillStyle = INK;
  context.font = font;
  [context.textAlign, context.textBaseline] = [align, 'alphabetic'];
  context.fillText(text, x, y);
}

/**
 * @param {Blob} blob
 * @param {string} name
 */
function save(blob, name) {
  download(blob, name);
  return 'Saved.';
}
