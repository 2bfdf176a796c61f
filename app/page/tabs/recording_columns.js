/** Columns of the tables of recordings and reports. */

/** @import { RecordingEntry, ReportEntry } from '../types/server.js' */
/** @import { Column } from '../widgets/file_table.js' */

import { create } from '../core/dom.js';
import { formatBytes } from '../core/units.js';

/** @typedef {Pick<RecordingEntry, 'name' | 'task' | 'filter' | 'episode' | 'faults'>} RunFile */

const TIME = new Intl.DateTimeFormat('en-GB', { hour: '2-digit', minute: '2-digit' });
const DAY = new Intl.DateTimeFormat('en-GB', { day: 'numeric', month: 'short' });
const DAY_AND_YEAR = new Intl.DateTimeFormat('en-GB', { dateStyle: 'medium' });

/**
 * @template {{name: string}} F
 * @param {string} name
 * @param {string} title
 * @param {string} help
 * @param {(file: F) => string | number | null} value
 * @returns {Column<F>}
 */
const textColumn = (name, title, help, value) => ({
  name,
  title,
  help,
  value,
  content: (file) => String(value(file) ?? '–'),
});

/** @type {Column<RunFile>[]} */
const RUN_COLUMNS = [
  textColumn('task', 'task', 'Task', ({ task }) => task),
  textColumn('filter', 'filter', 'Filter', ({ filter }) => filter),
  { ...textColumn('episode', 'episode', 'Episode index', ({ episode }) => episode), number: true },
  {
    ...textColumn('faults', 'faults', 'Sensor faults', ({ task, faults }) =>
      task === null ? null : faults || 'as recorded',
    ),
    hint: ({ faults }) => faults,
  },
];

/** @type {Column<RecordingEntry>} */
const DATA_COLUMN = {
  ...textColumn('data', 'data', 'Data set in the catalog', ({ run }) => run?.data ?? null),
  hint: ({ data_hash: hash }) => hash && `Hash of the episode: ${hash.slice(0, 12)}`,
};

/** @type {Column<{name: string, bytes: number}>} */
const SIZE_COLUMN = {
  name: 'bytes',
  title: 'size',
  help: 'Size on disk',
  value: ({ bytes }) => bytes,
  content: ({ bytes }) => formatBytes(bytes),
  number: true,
};

/**
 * @template {{name: string}} F
 * @param {(file: F) => string} date
 * @returns {Column<F>}
 */
const dateColumn = (date) => ({
  name: 'when',
  title: 'date',
  help: 'Date of writing',
  value: (file) => Date.parse(date(file)),
  content: (file) => formatDate(new Date(date(file))),
  hint: (file) => new Date(date(file)).toLocaleString('en-GB'),
  number: true,
});

/** @type {Column<RecordingEntry>[]} */
export const RECORDING_COLUMNS = [
  {
    ...textColumn('name', 'name', 'File name', (/** @type {RecordingEntry} */ { name }) => name),
    content: contentNote,
    hint: (file) => (file.reading ? '' : file.problem),
  },
  ...RUN_COLUMNS,
  DATA_COLUMN,
  SIZE_COLUMN,
  dateColumn(({ modified }) => modified),
];

/** @type {Column<ReportEntry>[]} */
export const REPORT_COLUMNS = [
  {
    ...textColumn('name', 'name', 'File name', (/** @type {ReportEntry} */ { name }) => name),
    content: () => '',
    hint: ({ title }) => title,
  },
  ...RUN_COLUMNS,
  SIZE_COLUMN,
  dateColumn(({ created }) => created),
];

/**
 * Returns what follows the name of a recording: a note about its content.
 * @param {RecordingEntry} file
 */
function contentNote(file) {
  if (file.reading) return smallNote('reading …');
  if (!file.application) return smallNote('unreadable', 'bad');
  return file.problem ? smallNote(`written by ${file.application}`) : '';
}

/**
 * @param {string} textContent
 * @param {string} [className]
 */
export const smallNote = (textContent, className = '') =>
  create('small', { textContent, className });

/**
 * Formats a date of today as a time, and any other one as a day.
 * @param {Date} date
 */
export function formatDate(date) {
  const now = new Date();
  if (date.toDateString() === now.toDateString()) return TIME.format(date);
  return (date.getFullYear() === now.getFullYear() ? DAY : DAY_AND_YEAR).format(date);
}
