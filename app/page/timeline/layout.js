/** Heights of the charts, and notes in place of charts. */

/** @import { Track } from './chart.js' */

import { create } from '../core/dom.js';
import { scaled } from '../core/palette.js';

const NOTE_HEIGHT = scaled(26); // px of a note in place of a chart
const LINE_HEIGHT = scaled(14); // px of a line of a legend

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
      series.map(({ name, sigma, comparison }) => [name, Boolean(sigma), comparison]),
    ]),
  );

/**
 * Returns the height of each track in px: the height of its legend, and an equal share of the remaining height.
 * The lowest track always has a chart, because of the axis.
 * @param {Track[]} tracks
 * @param {number} height px
 */
export function trackHeights(tracks, height) {
  const noteOnly = tracks.map(({ note }, i) => Boolean(note) && i < tracks.length - 1);
  const minimum = tracks.map(({ series }, i) => {
    if (noteOnly[i]) return NOTE_HEIGHT;
    const names = new Set(series.map(({ name }) => name));
    return 3 + LINE_HEIGHT * (1 + Math.max(names.size, 2));
  });
  const remaining = height - minimum.reduce((a, b) => a + b, 0);
  const share = remaining / noteOnly.filter((value) => !value).length;
  return minimum.map((value, i) => Math.floor(value + (noteOnly[i] ? 0 : share)));
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
