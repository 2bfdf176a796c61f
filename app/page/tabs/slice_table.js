/** Table of data slices in which a score is larger; each row opens the worst step of its slice. */

/** @import { FailureScore, ErrorSlice, Condition } from '../types/server.js' */

import { columnHeading, create, createButton, element, fillTable } from '../core/dom.js';
import { percent, sentence, significant, withUnit } from '../core/units.js';
import { navigateRows } from '../widgets/row_navigation.js';
import { markRow } from './event_table.js';
import { scoreUnit } from './failure_scores.js';

const NO_BREAK = '\u00a0'; // space that keeps a unit on the line of its number

/** @typedef {{slice: ErrorSlice, row: HTMLTableRowElement, button: HTMLButtonElement}} SliceRow */

export class SliceTable {
  #table;
  #open;
  /** @type {FailureScore | undefined} */
  #score;
  /** @type {SliceRow[]} */
  #rows = [];

  /**
   * @param {HTMLTableElement} table
   * @param {(step: {episode: number, step: number}, inputTime: number) => void} open
   */
  constructor(table, open) {
    this.#table = table;
    this.#open = open;
    navigateRows(element('tbody', HTMLTableSectionElement, table));
  }

  /**
   * @param {FailureScore | undefined} score
   * @param {number} episodes number of searched episodes
   */
  show(score, episodes) {
    if (score === this.#score) return;
    this.#score = score;
    const slices = score?.slices?.rows ?? [];
    const headings = score && slices.length ? headingsOf(score) : [];
    this.#rows = score ? slices.map((slice, i) => this.#row(slice, score, episodes, i)) : [];
    fillTable(
      this.#table,
      headings.map(([text, title, className]) => columnHeading(text, { title, className })),
      this.#rows.map(({ row }) => row),
    );
  }

  /**
   * Highlights the slices whose worst step is at the cursor.
   * @param {number} episode
   * @param {number} step
   */
  mark(episode, step) {
    for (const { slice, row, button } of this.#rows)
      markRow(row, button, slice.worst[0] === episode && slice.worst[1] === step);
  }

  /**
   * @param {ErrorSlice} slice
   * @param {FailureScore} score
   * @param {number} count of searched episodes
   * @param {number} i place in the table
   * @returns {SliceRow}
   */
  #row(slice, score, count, i) {
    const { scale } = scoreUnit(score);
    const { inside, outside, episodes, steps, share, worst } = slice;
    const [episode, step] = worst;
    const row = document.createElement('tr');
    const open = (/** @type {MouseEvent} */ { timeStamp }) =>
      this.#open({ episode, step }, timeStamp);
    const button = createButton('title', sliceText(slice), open, {
      title: `Open the worst step: episode ${episode}, step ${step}`,
      ariaLabel: `${sliceSentence(slice, score, count)} Worst: episode ${episode}, step ${step}`,
      tabIndex: i ? -1 : 0,
    });
    row.insertCell().append(button);
    const texts = [
      significant(inside && scale * inside),
      significant(outside && scale * outside),
      ratioText(slice, ' ×'),
      `${episodes.length} of ${count}`,
      `${steps} (${percent(share)})`,
    ];
    for (const text of texts) row.append(create('td', { className: 'number', textContent: text }));
    return { slice, row, button };
  }
}

/**
 * Title, explanation and class of each column.
 * @param {FailureScore} score
 */
function headingsOf(score) {
  const { unit } = scoreUnit(score);
  return [
    ['slice', 'Steps that meet these conditions', ''],
    [withUnit('inside', unit), `Mean ${score.title} over the steps of the slice`, 'number'],
    [withUnit('outside', unit), `Mean ${score.title} over all other steps`, 'number'],
    ['ratio', 'Ratio of the means with its 95 % interval over episodes', 'number'],
    ['episodes', 'Episodes with steps in the slice', 'number'],
    ['steps', 'Number of steps, and share of all steps', 'number'],
  ];
}

/**
 * Describes a slice, its effect and its size: Position error is 1.5 times as large (1.3 to 1.7) where blackout: ...
 * @param {ErrorSlice} slice
 * @param {FailureScore} score
 * @param {number} count of searched episodes
 */
export function sliceSentence(slice, score, count) {
  const size = `${slice.episodes.length} of ${count} episodes, ${percent(slice.share)} of steps`;
  return sentence(
    `${score.title} is ${ratioText(slice, ' times as large')} where ${sliceText(slice)}: ${size}`,
  );
}

/** @param {ErrorSlice} slice */
const sliceText = ({ conditions }) => conditions.map(conditionText).join(' and ');

/**
 * Returns the ratio with its unit, and its interval.
 * @param {ErrorSlice} slice
 * @param {string} unit
 */
function ratioText({ ratio, low, high }, unit) {
  const interval = low === null || high === null ? '' : ` (${factor(low)} to ${factor(high)})`;
  return `${factor(ratio)}${unit}${interval}`;
}

/** @param {string} number without zeros at its end */
const short = (number) => number.replace(/(\.\d*?)0+$/, '$1').replace(/\.$/, '');

/** @param {number | null} value with two significant digits */
const factor = (value) => (value === null ? '–' : String(Number(value.toPrecision(2))));

/**
 * Describes a condition in units of the page: 1 s < outage length ≤ 2 s, contact, free motion, or policy is push.
 * @param {Condition} condition
 */
export function conditionText({ covariate, unit, low, high, category }) {
  const no = `no ${covariate}`;
  if (category === 'yes' || category === covariate) return covariate;
  if (category === 'no' && covariate === 'contact') return 'free motion';
  if (category === 'no' || category === no) return no;
  if (category !== null) return `${covariate} is ${category}`;
  const end = (/** @type {number | null} */ value) =>
    withUnit(short(significant(value)), unit.replace('deg', '°')).replace(' ', NO_BREAK);
  if (high === null) return `${covariate} >${NO_BREAK}${end(low)}`;
  const above = low === null ? '' : `${end(low)}${NO_BREAK}< `;
  return `${above}${covariate} ≤${NO_BREAK}${end(high)}`;
}
