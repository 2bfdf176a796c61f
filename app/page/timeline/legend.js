/** Legends of the charts: names, line samples and current values. */

/** @import { Trace } from '../data/trace.js' */
/** @import { Track } from './chart.js' */

import { create } from '../core/dom.js';
import { channelVariable, cssVariable, lineSample } from '../core/colours.js';
import { displayName, fixed, significant } from '../core/units.js';
import { seriesStyle } from './chart.js';
import { areaSample } from './stacked_weights.js';

const CHARACTER = 0.61; // rem
const STANDALONE = 'standalone'; // end of the name of the only standalone run, of the modality in its picker
const SAMPLE_AND_VALUE = { full: 8, compact: 7.1, dense: 7.5 }; // rem

/** @typedef {{text: Text, track: Track, index: number}} ValueCell index of the series in the track */

/**
 * Creates the legend of a track.
 * @param {Track} track
 * @param {Trace} trace
 * @param {boolean} compared whether a comparison run is displayed
 * @param {boolean} compact whether names are short
 * @returns {{element: HTMLElement, cells: ValueCell[]}}
 */
export function legend(track, trace, compared, compact) {
  const { title, unit, help, series } = track;
  const heading = create('h3', { textContent: unit ? `${title} (${unit})` : title });
  heading.title = help ?? heading.textContent ?? '';
  const list = create('dl');
  /** @type {ValueCell[]} */
  const cells = [];
  const names = [...new Set(series.map((item) => item.name))];
  // The estimate first, because the last ones of many rows may be cut.
  if (compact) names.sort((a, b) => Number(b === 'fused') - Number(a === 'fused'));
  for (const name of names) {
    const index = series.findIndex((item) => item.name === name);
    const first = series[index];
    const { dash, width } = seriesStyle(first);
    const sample = first.stacked
      ? areaSample(name, index)
      : lineSample(colourOf(first), dash, width);
    const label = track.ofModalities ? displayName(name) : trace.label(name);
    const short = name.endsWith(STANDALONE) ? STANDALONE : displayName(name);
    const text = create('span', { textContent: compact && trace.fuses ? short : label });
    list.append(create('dt', { title: label }, sample, text));
    for (const comparison of compared ? [false, true] : [false]) {
      const text = new Text();
      const index = series.findIndex(
        (item) => item.name === name && Boolean(item.comparison) === comparison,
      );
      if (index >= 0) cells.push({ text, track, index });
      list.append(create('dd', {}, text));
    }
  }
  return { element: create('div', { className: 'legend' }, heading, list), cells };
}

/**
 * Returns the CSS variable with the colour of a series.
 * @param {import('./chart.js').Series} series
 */
export const colourOf = ({ name, line }) =>
  line === undefined ? cssVariable(name) : channelVariable(line);

/**
 * Returns the width of a legend that shows its names in full, in rem.
 * @param {Trace} trace
 * @param {Track[]} tracks
 * @param {keyof typeof SAMPLE_AND_VALUE} kind full: one column of labels; else two columns of short names
 */
export function legendWidth(trace, tracks, kind) {
  const isFull = kind === 'full';
  const sources = trace.sources.map((name) =>
    isFull || !trace.fuses ? trace.label(name) : displayName(name),
  );
  const channels = tracks.flatMap(({ series }) => series.filter(({ line }) => line !== undefined));
  const names = [...sources, ...channels.map(({ name }) => name)];
  const width = CHARACTER * Math.max(...names.map(({ length }) => length));
  return (isFull ? 1 : 2) * (width + SAMPLE_AND_VALUE[kind]);
}

/**
 * Writes the values at a step into a legend.
 * @param {ValueCell[]} cells
 * @param {number} step
 */
export function updateLegend(cells, step) {
  for (const { text, track, index } of cells) {
    const value = formatValue(track.series[index].values[step], track);
    if (text.data !== value) text.data = value;
  }
}

/**
 * @param {number} value
 * @param {Track} track
 */
export const formatValue = (value, { digits }) =>
  digits === undefined ? significant(value) : fixed(value, digits);
