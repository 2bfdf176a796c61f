/** Heights of the charts, and notes in place of charts. */

/** @import { Track } from './chart.js' */

import { create } from '../core/dom.js';
import { scaled } from '../core/colours.js';
import { sum } from '../data/arrays.js';
import { GUTTER } from './chart.js';

const NOTE_HEIGHT = scaled(26); // px of a note in place of a chart
const LINE_HEIGHT = scaled(12); // px of a line of a legend
const STACKED_HEIGHT = scaled(52); // px of a chart of areas where the room is short, its axis included
const COMPACT_HEIGHT = scaled(215); // px of a timeline below which legends have two columns and short names
const CHANNEL_ROWS = 8; // of a legend of many channels, which has two columns then
const BAND_WEIGHT = 2; // share of the remaining height of a chart with a ±2σ band, relative to others

/**
 * Returns the properties of tracks that require new charts when they change.
 * @param {Track[]} tracks
 */
export const layoutKey = (tracks) =>
  JSON.stringify(
    tracks.map(({ title, note, unit, series }) => [
      title,
      note,
      unit,
      series.map(({ name, sigma, comparison, stacked }) => [
        name,
        Boolean(sigma),
        comparison,
        stacked,
      ]),
    ]),
  );

/**
 * Returns whether the legends have two columns and short names.
 * @param {number} height px of the timeline
 */
export const isCompact = (height) => height < COMPACT_HEIGHT;

/**
 * Returns whether the legend of a track has two columns: all of its rows would not fit.
 * @param {Track} track
 * @param {number} height px
 */
export const isDense = ({ series }, height) =>
  height < legendHeight(new Set(series.map(({ name }) => name)).size);

/** @param {number} rows */
const legendHeight = (rows) => 3 + LINE_HEIGHT * (1 + rows);

/**
 * Returns the height of each track in px. Each has room for its legend, those with a ±2σ band get most of the rest, so that
 * the truth outside of it is visible, and in a low timeline the stacked ones shrink first, then all. The lowest track always has a chart, because of the axis.
 * @param {Track[]} tracks
 * @param {number} height px
 */
export function trackHeights(tracks, height) {
  const compact = isCompact(height + GUTTER.axis);
  const noteOnly = tracks.map(({ note }, i) => Boolean(note) && i < tracks.length - 1);
  const stacked = tracks.map(({ series }) => series.some((item) => item.stacked));
  const legends = tracks.map(({ series }, i) => {
    if (noteOnly[i]) return NOTE_HEIGHT;
    const names = new Set(series.map(({ name }) => name));
    const size = series[0]?.line === undefined ? names.size : Math.min(names.size, CHANNEL_ROWS);
    const rows = legendHeight(compact ? Math.ceil(size / 2) : Math.max(size, 2));
    return stacked[i] ? Math.min(rows, STACKED_HEIGHT) : rows;
  });
  // Where the room is short, the charts of areas shrink first, to the height of their legends.
  const spare = stacked.map((isStacked, i) => (isStacked ? STACKED_HEIGHT - legends[i] : 0));
  const room = Math.max(height - sum(legends), 0);
  const part = sum(spare) > room ? room / sum(spare) : 1;
  const minimum = legends.map((value, i) => value + part * spare[i]);
  const least = sum(minimum);
  if (least >= height) return minimum.map((value) => Math.floor((value / least) * height));
  /** @type {number[]} */
  const weights = tracks.map(({ series }, i) =>
    noteOnly[i] ? 0 : series.some(({ sigma }) => sigma) ? BAND_WEIGHT : 1,
  );
  const share = (height - least) / sum(weights);
  return minimum.map((value, i) => Math.floor(value + weights[i] * share));
}

/**
 * @param {string} text
 * @param {number} height px
 */
export function noteElement(text, height) {
  const note = create('p', { className: 'track-note', textContent: text });
  note.style.height = `${height}px`;
  return note;
}
