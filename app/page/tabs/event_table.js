/** Table of failure events, the worst first; each row moves the cursor, and has a permalink. */

/** @import { FailureEvent, FailureScore, Failures } from '../types/server.js' */

import { copyText } from '../core/clipboard.js';
import { columnHeading, createButton, element, fillTable } from '../core/dom.js';
import { displayName, fixed, percent, significant, stepLabel, withUnit } from '../core/units.js';
import { updateLabel } from '../data/trace.js';
import { navigateRows, setTabStop } from '../widgets/row_navigation.js';
import { formatScore, scoreUnit } from './failure_scores.js';

/**
 * @typedef {object} EventColumn
 * @property {string} title
 * @property {string} [help]
 * @property {boolean} [number]
 * @property {(event: FailureEvent) => string} content
 * @property {(event: FailureEvent) => string} [hint]
 */
/** @typedef {{event: FailureEvent, row: HTMLTableRowElement, button: HTMLButtonElement}} EventRow */

const COPIED_TIME = 1500; // ms
const LINK_ICON =
  '<svg viewBox="0 0 16 16" aria-hidden="true"><path d="m6.3 9.7 3.4-3.4M7 4.6l1.4-1.3a2.9 2.9 0 0 1 4.2 4.1L11.2 8.8M9 11.4l-1.4 1.3a2.9 2.9 0 0 1-4.2-4.1L4.8 7.2"/></svg>';

export class EventTable {
  #table;
  #open;
  /** @type {EventRow[]} */
  #rows = [];

  /**
   * @param {HTMLTableElement} table
   * @param {(event: FailureEvent, inputTime: number) => void} open
   */
  constructor(table, open) {
    this.#table = table;
    this.#open = open;
    navigateRows(element('tbody', HTMLTableSectionElement, table));
  }

  /**
   * @param {Failures | undefined} failures
   * @param {FailureScore | undefined} score
   * @param {FailureEvent[]} events
   */
  show(failures, score, events) {
    const columns = failures && score?.events ? eventColumns(failures, score, score.events) : [];
    const headings = columns.map(({ title, help = '', number }) =>
      columnHeading(title, { className: number ? 'number' : '', title: help }),
    );
    if (columns.length) headings.push(columnHeading('', { ariaLabel: 'Link' }));
    this.#rows = score ? events.map((event, i) => this.#row(columns, event, score, i)) : [];
    fillTable(
      this.#table,
      headings,
      this.#rows.map(({ row }) => row),
    );
  }

  /**
   * Highlights the events at the cursor.
   * @param {(event: FailureEvent) => boolean} isCurrent
   */
  mark(isCurrent) {
    for (const { event, row, button } of this.#rows) {
      const current = isCurrent(event);
      if (current !== row.classList.contains('here')) markRow(row, button, current);
    }
  }

  /**
   * Scrolls to an event.
   * @param {number} index
   */
  point(index) {
    if (!this.#table.checkVisibility()) return;
    setTabStop(this.#rows[index].row, this.#table.contains(document.activeElement));
  }

  /**
   * @param {EventColumn[]} columns the first one contains the button
   * @param {FailureEvent} event
   * @param {FailureScore} score
   * @param {number} i place in the table
   * @returns {EventRow}
   */
  #row(columns, event, score, i) {
    const { episode, step, time, phase } = event;
    const row = document.createElement('tr');
    const open = (/** @type {MouseEvent} */ { timeStamp }) => this.#open(event, timeStamp);
    const button = createButton('title', columns[0].content(event), open, {
      ariaLabel: `Episode ${episode}, ${stepLabel(step, time)}: ${score.title} ${formatScore(score, event.value)}, ${phase}`,
    });
    columns.forEach(({ content, hint, number }, c) => {
      const cell = row.insertCell();
      if (number) cell.className = 'number';
      if (hint) cell.title = hint(event);
      cell.append(c ? content(event) : button);
    });
    const link = linkButton(event);
    button.tabIndex = link.tabIndex = i ? -1 : 0;
    row.insertCell().append(link);
    return { event, row, button };
  }
}

/**
 * Highlights a row of a table, also for screen readers.
 * @param {HTMLTableRowElement} row
 * @param {HTMLButtonElement} button of the row
 * @param {boolean} current
 */
export function markRow(row, button, current) {
  row.classList.toggle('here', current);
  if (current) button.setAttribute('aria-current', 'true');
  else button.removeAttribute('aria-current');
}

/**
 * Creates the button that copies the permalink of an event.
 * @param {FailureEvent} event
 */
function linkButton({ episode, step, time, link }) {
  const title = `Copy link to episode ${episode}, ${stepLabel(step, time)}`;
  const copy = async () => {
    const success = await copyText(new URL(link, location.href).href);
    button.textContent = success ? '✓' : 'not permitted';
    setTimeout(() => (button.innerHTML = LINK_ICON), COPIED_TIME);
  };
  const button = createButton('quiet link', '', copy, { title, ariaLabel: title });
  button.innerHTML = LINK_ICON;
  return button;
}

/**
 * @param {Failures} failures
 * @param {FailureScore} score
 * @param {FailureEvent[]} events all events of the score
 * @returns {EventColumn[]}
 */
export function eventColumns({ layers, scores }, score, events) {
  const main = scoreUnit(scores.find(({ name }) => name === 'error') ?? score);
  const { unit, scale } = scoreUnit(score);
  const number = true;
  /** @type {EventColumn[]} */
  const columns = [
    { title: 'episode', content: ({ episode }) => String(episode) },
    {
      title: 'step',
      content: ({ step }) => String(step),
      number,
      hint: ({ first, last }) => `Worst of steps ${first} to ${last}`,
    },
    {
      title: unit ? `${score.title} ${unit}` : score.title,
      content: ({ value }) => significant(value === null ? null : scale * value),
      number,
    },
    {
      title: 'phase',
      content: ({ phase }) => phase,
      hint: ({ phase, other_phases: others }) => [phase, ...others].join(', '),
    },
  ];
  if (events.some(({ time }) => Number.isFinite(time)))
    columns.splice(2, 0, {
      title: 'time s',
      content: ({ time }) => fixed(time, 2),
      number,
      hint: ({ first_time: first, last_time: last }) => `${fixed(first, 2)} to ${fixed(last, 2)} s`,
    });
  const modalities = layers.slice(0, -1); // the last layer is the fused estimate
  const fuses = modalities.length > 1;
  const label = (/** @type {string} */ layer) => (layer === 'fused' ? layer : updateLabel(layer));
  layers.forEach((layer, i) => {
    if (layer === 'fused' ? score.name === 'error' : !fuses) return;
    if (events.every(({ error }) => error[i] === null)) return; // the filter does not report this update
    columns.push({
      title: withUnit(fuses ? label(layer) : 'error', main.unit),
      content: ({ error }) => {
        const value = error[i];
        return fixed(value === null ? null : main.scale * value, 2);
      },
      number,
      help: 'Main error of the task, such as the position error',
    });
  });
  if (score.name !== 'nees' && events[0]?.nees !== null)
    columns.push({
      title: 'NEES/n',
      content: ({ nees }) => fixed(nees),
      number,
      help: 'Normalised estimation error squared per component: mean 1 if the covariance is consistent',
    });
  if (fuses && events[0]?.effective_weights)
    columns.push({
      title: 'dominant',
      content: (event) => dominantModality(modalities, event),
      help: 'Modality with the largest effective weight (mean over the components)',
    });
  return columns;
}

/**
 * @param {string[]} modalities
 * @param {FailureEvent} event
 */
function dominantModality(modalities, { effective_weights: weights }) {
  const values = (weights ?? []).map(Number);
  const largest = values.indexOf(Math.max(...values));
  return `${displayName(modalities[largest])} ${percent(values[largest])}`;
}
