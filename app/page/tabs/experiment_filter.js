/** The text that selects rows of the Experiments tab: words, and conditions such as `nees > 2`. */

/** @import { ExperimentRow } from '../types/server.js' */

import { entryNames, numberIn, provenanceOf } from './experiment_provenance.js';
import { faultsText, numbersOf, valueOf } from './experiment_rows.js';

/** @typedef {(row: ExperimentRow) => boolean} Test */

/** A quoted or plain name or word, and optionally a comparison with a quoted or plain value. */
const PART =
  /\s*("[^"]*"|(?:[^\s"<>=≤≥!]|!(?!=))*)(?:\s*(>=|<=|==|!=|[<>=≤≥])\s*("[^"]*"|[^\s"]*))?/y;
const LISTED = 12; // columns in a message

/** @type {Record<string, (value: number, limit: number) => boolean>} */
const ORDERS = {
  '>': (value, limit) => value > limit,
  '<': (value, limit) => value < limit,
  '>=': (value, limit) => value >= limit,
  '<=': (value, limit) => value <= limit,
};
/** @type {Record<string, string>} */
const SYNONYMS = { '==': '=', '≥': '>=', '≤': '<=' };

/**
 * Returns the rows that have all words, in any text or the provenance, and meet all conditions; and what is wrong with
 * the text, empty if nothing is. A wrong condition matches no row.
 * @param {ExperimentRow[]} rows
 * @param {string} text
 */
export function matching(rows, text) {
  /** @type {string[]} */
  const problems = [];
  /** @type {Test[]} */
  const tests = [];
  PART.lastIndex = 0;
  while (PART.lastIndex < text.trimEnd().length) {
    const start = PART.lastIndex;
    const [part, name, sign, value] = PART.exec(text) ?? [];
    const result = part ? testOf(rows, part.trim(), name, sign, value) : OPEN_QUOTE;
    if (typeof result === 'string') problems.push(`“${text.slice(start).trim()}”: ${result}`);
    else if ('problem' in result) problems.push(`“${(part ?? '').trim()}”: ${result.problem}`);
    else tests.push(result);
    if (typeof result === 'string') break;
  }
  const matched = problems.length ? [] : rows.filter((row) => tests.every((test) => test(row)));
  return { rows: matched, problem: problems.join(' ') };
}

const OPEN_QUOTE = 'the closing quotation mark is missing.';

/**
 * The test of a part of the text, or what is wrong with the part.
 * @param {ExperimentRow[]} rows
 * @param {string} part
 * @param {string} quoted name or word
 * @param {string | undefined} sign
 * @param {string | undefined} value
 * @returns {Test | {problem: string}}
 */
function testOf(rows, part, quoted, sign, value = '') {
  const name = unquoted(quoted);
  if (sign === undefined) return (row) => searched(row).includes(normal(name));
  if (!name) return { problem: `the column before ${sign} is missing, as in nees${sign}2.` };
  const key = columnKey(rows, name);
  if (key === undefined) {
    // A fault such as blackout=0.4 is a word.
    if (rows.some((row) => searched(row).includes(normal(part))))
      return (row) => searched(row).includes(normal(part));
    return { problem: `there is no column ${name}. ${columnList(rows, name)}` };
  }
  if (!value) return { problem: `the value after ${sign} is missing.` };
  const text = unquoted(value);
  return condition(key, SYNONYMS[sign] ?? sign, key === 'faults' ? faultsText(text) : text);
}

/**
 * @param {string} key
 * @param {string} sign
 * @param {string} text
 * @returns {Test | {problem: string}}
 */
function condition(key, sign, text) {
  const limit = text.endsWith('%') ? scaledNumber(text.slice(0, -1), 0.01) : scaledNumber(text, 1);
  const order = ORDERS[sign];
  if (order) {
    if (limit === null) return { problem: `${text} is not a number; compare texts with = or !=.` };
    return (row) => {
      const number = numberIn(valueOf(row, key));
      return number !== null && order(number, limit);
    };
  }
  return (row) => {
    const value = key === 'faults' ? faultsText(row.faults) : valueOf(row, key);
    if (value === null) return false;
    const number = numberIn(value);
    const equal =
      number !== null && limit !== null ? number === limit : normal(String(value)) === normal(text);
    return equal === (sign === '=');
  };
}

/**
 * @param {string} text of a number
 * @param {number} factor
 */
function scaledNumber(text, factor) {
  const number = numberIn(text.replace('−', '-').trim());
  return number === null ? null : number * factor;
}

/**
 * Key of the column with a name: its key or title in upper or lower case, with or without the unit.
 * @param {ExperimentRow[]} rows
 * @param {string} name
 */
function columnKey(rows, name) {
  const units = [...new Set(rows.map(({ unit }) => unit))];
  const entries = entryNames(rows);
  if (entries.includes(name)) return name;
  const numbers = Object.entries(numbersOf(rows)).map(([key, { title }]) => {
    const name = title.replace(/, .*/, ''); // without the unit
    const others = [name, name.replaceAll(' ', '_')];
    return { key, names: [key, title, ...others, ...units.map((unit) => `${title}, ${unit}`)] };
  });
  const others = [...TEXT_KEYS, ...entries].map((key) => ({ key, names: [key] }));
  const columns = [...numbers, { key: 'name', names: ['checkpoint'] }, ...others];
  return columns.find(({ names }) => names.some((text) => normal(text) === normal(name)))?.key;
}

const TEXT_KEYS = /** @type {const} */ (['name', 'filter', 'task', 'faults']);

/**
 * Columns in a message, first the ones whose names contain a text: `optimizer.lr` for `lr`.
 * @param {ExperimentRow[]} rows
 * @param {string} name
 */
function columnList(rows, name) {
  const all = [...Object.keys(numbersOf(rows)), ...TEXT_KEYS, ...entryNames(rows)];
  const similar = all.filter((column) => normal(column).includes(normal(name)));
  const names = [...new Set([...similar, ...all])];
  const listed = names.slice(0, LISTED).map((name) => (/[\s<>=!]/.test(name) ? `"${name}"` : name));
  const more = names.length > LISTED ? ` and ${names.length - LISTED} more` : '';
  return `Columns: ${listed.join(', ')}${more}. Quote names with spaces.`;
}

/** @param {string} text */
const unquoted = (text) => text.replace(/^"(.*)"$/, '$1');

/** Text to compare, whatever its case and Unicode form. @param {string} text */
const normal = (text) => text.normalize().toLowerCase();

/** @type {WeakMap<ExperimentRow, string>} */
const texts = new WeakMap();

/**
 * All texts of a row that words are searched in.
 * @param {ExperimentRow} row
 */
function searched(row) {
  const cached = texts.get(row);
  if (cached !== undefined) return cached;
  const entries = Object.entries(provenanceOf(row)).map(([name, value]) => `${name} ${value}`);
  const cells = [row.name, row.filter, row.task, faultsText(row.faults)];
  const text = normal([...cells, ...entries].join('\n'));
  texts.set(row, text);
  return text;
}
