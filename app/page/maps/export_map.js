/** The maps as files: a picture (PNG, SVG) or a table (CSV), made here in the browser. */

import { MARGIN, drawMap } from './draw_map.js';
import { digits, ends, log } from './map_values.js';
import { TABLES } from '../core/palette.js';
import { SvgPen } from './svg_context.js';
import { fixed } from '../core/units.js';

const SIDE = 300; // px of a map's square
const SHEET = { pad: 14, title: 24, bar: 8, foot: 40, sharp: 2 };
const INK = '#222';

/** @param {HTMLElement} host with buttons and an output @param {() => object} shown as `Heatmaps.shown` has it */
export function saving(host, shown) {
  const [choice, output] = [host.querySelector('select'), host.querySelector('output')];
  const picked = () => {
    const all = shown();
    const only = all.figures.filter(({ name }) => name === choice.value);
    return { ...all, figures: only.length ? only : all.figures };
  };
  const actions = {
    png: async (sheet, name) => download(await png(sheet), `${name}.png`),
    svg: async (sheet, name) => download(new Blob([svg(sheet)], { type: 'image/svg+xml' }), `${name}.svg`),
    csv: async (sheet, name) => download(new Blob([csv(sheet)], { type: 'text/csv' }), `${name}.csv`),
    copy: async (sheet) => {
      await navigator.clipboard.write([new ClipboardItem({ 'image/png': png(sheet) })]);
      return 'Copied as a picture.';
    },
  };
  host.addEventListener('click', async ({ target }) => {
    const action = actions[target.dataset?.as];
    if (!action) return;
    const sheet = picked();
    if (!sheet.maps) return;
    try {
      output.textContent = (await action(sheet, named(sheet, choice.value))) ?? 'Saved.';
    } catch (error) {
      output.textContent = `Not done: ${error.message}`;
    }
  });
  return (layers) => {
    const before = choice.value;
    choice.replaceChildren(new Option('all maps', ''), ...layers.map((name) => new Option(name)));
    choice.value = layers.includes(before) ? before : '';
    output.textContent = '';
  };
}

function named({ trace, maps }, layer) {
  const { task, filter, episode } = trace.selection;
  return [task, filter, `episode${episode}`, `step${maps.step}`, layer || 'maps'].join('-').replaceAll(/[^\w.-]+/g, '-');
}

function described({ trace, maps, title }) {
  const { task, filter, data, episode, faults } = trace.selection;
  const angle = maps.angle === null ? '' : `, cut at ${fixed((maps.angle * 180) / Math.PI, 1)}°`;
  return `${task}, ${filter}, ${data} episode ${episode}, ${faults ? `sensors ${faults}, ` : ''}step ${maps.step}${angle}: ${title}`;
}

/** A cell a row. @returns {string} */
export function csv(sheet) {
  const { maps, figures } = sheet;
  const logs = figures.map(({ layer }) => log(maps, layer));
  const { size, half_width: half, centre } = maps;
  const middle = (index) => 100 * (((index + 0.5) / size) * 2 - 1) * half;
  const deepest = figures.map(({ name, layer }) => `${name} ${fixed(maps.log_max[layer] - maps.log_range[layer], 3)}`).join(' / ');
  const rows = [
    `# Beliefscope: ${described({ ...sheet, title: 'natural logarithm of the likelihood' })}`.replaceAll('\u2212', '-'),
    `# dx and dy: offset from the true position; x and y: position in the world. Lowest value told, or less: ${deepest}`.replaceAll('\u2212', '-'),
    ['dx_cm', 'dy_cm', 'x_cm', 'y_cm', ...figures.map(({ name }) => `${name}_ln_likelihood_nats`)].join(','),
  ];
  for (let i = 0; i < size * size; i++) {
    const offset = [middle(i % size), middle(Math.floor(i / size))];
    const places = [...offset, ...offset.map((d, axis) => d + 100 * centre[axis])];
    rows.push([...places.map((cm) => cm.toFixed(3)), ...logs.map((values) => values[i].toFixed(4))].join(','));
  }
  return `${rows.join('\n')}\n`;
}

/** @returns {string} */
export function svg(sheet) {
  const pen = new SvgPen();
  const [width, height] = extent(sheet);
  drawSheet(pen, sheet, width, height);
  return pen.document(width, height);
}

async function png(sheet) {
  const canvas = document.createElement('canvas');
  const [width, height] = extent(sheet);
  [canvas.width, canvas.height] = [SHEET.sharp * width, SHEET.sharp * height];
  const pen = canvas.getContext('2d');
  pen.scale(SHEET.sharp, SHEET.sharp);
  drawSheet(pen, sheet, width, height);
  return new Promise((resolve, reject) => {
    canvas.toBlob((blob) => (blob ? resolve(blob) : reject(new Error('the picture is too large'))), 'image/png');
  });
}

const column = SIDE + MARGIN.left + MARGIN.right;

function extent({ figures }) {
  return [2 * SHEET.pad + figures.length * column, SHEET.pad + SHEET.title + SIDE + MARGIN.bottom + SHEET.foot + SHEET.pad];
}

function drawSheet(pen, sheet, width, height) {
  pen.fillStyle = '#fff';
  pen.beginPath();
  pen.rect(0, 0, width, height);
  pen.fill();
  sheet.figures.forEach((figure, i) => {
    pen.save();
    pen.translate(SHEET.pad + i * column + MARGIN.left, SHEET.pad + SHEET.title);
    pen.fillStyle = INK;
    pen.font = '600 13px system-ui, sans-serif';
    [pen.textAlign, pen.textBaseline] = ['left', 'alphabetic'];
    pen.fillText(figure.name, 0, -8);
    drawBar(pen, figure);
    drawMap(pen, figure, SIDE, { ...sheet.look, text: INK, withY: true, hover: null });
    pen.restore();
  });
  pen.fillStyle = INK;
  pen.font = '10px system-ui, sans-serif';
  [pen.textAlign, pen.textBaseline] = ['left', 'alphabetic'];
  const words = described(sheet).split(': ');
  pen.fillText(words[0], SHEET.pad, height - SHEET.pad - 12);
  pen.fillText(`Colour: ${words.slice(1).join(': ')}`, SHEET.pad, height - SHEET.pad);
}

/** The colour bar, above the map's right end. */
function drawBar(pen, { shade, table }) {
  const canvas = document.createElement('canvas');
  [canvas.width, canvas.height] = [256, 1];
  const image = new ImageData(256, 1);
  new Uint32Array(image.data.buffer).set(TABLES[table]);
  canvas.getContext('2d').putImageData(image, 0, 0);
  const [low, high] = ends(shade, digits(shade));
  pen.font = '10px system-ui, sans-serif';
  pen.drawImage(canvas, SIDE - 130, -8 - SHEET.bar, 90, SHEET.bar);
  pen.textAlign = 'right';
  pen.fillText(low, SIDE - 134, -8);
  pen.textAlign = 'left';
  pen.fillText(high, SIDE - 36, -8);
}

function download(blob, name) {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}
