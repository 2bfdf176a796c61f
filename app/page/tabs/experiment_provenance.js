/** The provenance of the checkpoints of a sweep, such as their training settings, as columns. */

/** @import { ExperimentRow } from '../types/server.js' */
/** @import { SeedGroup } from './experiment_groups.js' */

/** @typedef {string | number | boolean | null} Entry */

const NUMBER = /^[+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?$/i;
const DATE = /^\d{4}-\d{2}-\d{2}(?:[T _]|$)/;
/** Last words of the names of times: `wall_time` and `createdAt`, but not `time_step`. */
const TIMES = ['time', 'timestamp', 'duration', 'seconds', 'runtime', 'at'];

/** Words in the names of results of the training, such as `final_loss`; a `loss_weight` is a setting. */
const RESULTS = ['loss', 'losses', 'metric', 'metrics', 'rmse', 'accuracy', 'score'];
const DISTINCT = 0.8; // number of different values over that of checkpoints, above which each has its own

/** @type {WeakMap<ExperimentRow, Record<string, Entry>>} */
const parsed = new WeakMap();

/**
 * Entries of a row, or of the first member of a group, by name: `model.width` of `{"model": {"width": 64}}`. Lists are
 * JSON text.
 * @param {ExperimentRow | SeedGroup} displayed
 */
export function provenanceOf(displayed) {
  const row = 'members' in displayed ? displayed.members[0] : displayed;
  const entries = parsed.get(row) ?? named(row, flattened(JSON.parse(row.provenance || '{}')));
  parsed.set(row, entries);
  return entries;
}

/** Of each sweep: every key that is pressed needs them. @type {WeakMap<ExperimentRow[], Map<string, Entry[]>>} */
const valuesOfRows = new WeakMap();

/**
 * Values of each entry by checkpoint, in the order of the rows, which must not change. Checkpoints without provenance
 * are left out.
 * @param {ExperimentRow[]} rows
 */
function entryValues(rows) {
  const values = valuesOfRows.get(rows) ?? collectValues(rows);
  valuesOfRows.set(rows, values);
  return values;
}

/** @param {ExperimentRow[]} rows */
function collectValues(rows) {
  const checkpoints = new Map(rows.map((row) => [row.checkpoint, provenanceOf(row)]));
  const all = [...checkpoints.values()].filter((entries) => Object.keys(entries).length);
  return new Map(
    [...new Set(all.flatMap(Object.keys))].map((name) => [
      name,
      all.map((entries) => entries[name] ?? null),
    ]),
  );
}

/**
 * Names of all entries, in the order of the rows.
 * @param {ExperimentRow[]} rows
 */
export const entryNames = (rows) => [
  ...new Set(rows.flatMap((row) => Object.keys(provenanceOf(row)))),
];

/**
 * Names of the entries that differ between the checkpoints with provenance.
 * @param {ExperimentRow[]} rows
 */
export const differingEntries = (rows) =>
  [...entryValues(rows)].filter(([, values]) => new Set(values).size > 1).map(([name]) => name);

/**
 * Names of the entries that distinguish settings of the training rather than its runs. All differing ones but seeds,
 * addresses, dates, results, and texts, numeric ids and times that differ for nearly every checkpoint. An absent entry
 * is a value.
 * @param {ExperimentRow[]} rows
 */
export function settingEntries(rows) {
  const all = [...entryValues(rows)].filter(([, values]) => new Set(values).size > 1);
  const haveSeeds = all.some(([name]) => isSeed(name));
  return all
    .filter(([name, values]) => {
      if (isSeed(name)) return false;
      const entries = values.filter((value) => value !== null);
      if (entries.every(isAddress) || entries.every((value) => DATE.test(String(value))))
        return false;
      const areNumbers = entries.every((value) => numberIn(value) !== null);
      const isDistinct = new Set(entries).size > DISTINCT * values.length;
      if (!areNumbers || hasWord(name, 'id') || TIMES.includes(wordsOf(name).at(-1) ?? ''))
        return !isDistinct;
      // Seeds repeat settings: numbers that hardly repeat are results. Without seeds, they can be settings that were
      // drawn at random, such as a learning rate.
      return !isResult(name) && !(haveSeeds && isDistinct);
    })
    .map(([name]) => name);
}

/** Whether a name is that of a seed. @param {string} name */
export const isSeed = (name) => hasWord(name, 'seed');

/** Whether a name is that of a result of the training. @param {string} name */
export const isResult = (name) =>
  RESULTS.some((word) => hasWord(name, word)) && !hasWord(name, 'weight');

/**
 * Whether a name has a word: `random_seed`, `trainSeed` and `data.seed` have the word seed.
 * @param {string} name
 * @param {string} word
 */
const hasWord = (name, word) => wordsOf(name).includes(word);

/** @param {string} name */
const wordsOf = (name) =>
  name
    .replace(/([a-z])([A-Z])/g, '$1 $2')
    .toLowerCase()
    .split(/[^a-z]+/)
    .filter(Boolean);

/**
 * Whether an entry has numbers, also stored as text, and no other values.
 * @param {ExperimentRow[]} rows
 * @param {string} name
 */
export function isNumeric(rows, name) {
  const values = rows.map((row) => provenanceOf(row)[name] ?? null).filter((v) => v !== null);
  return values.length > 0 && values.every((value) => numberIn(value) !== null);
}

/**
 * The finite number that a value is or that its text states; otherwise null.
 * @param {unknown} value
 */
export function numberIn(value) {
  const number = typeof value === 'string' && NUMBER.test(value) ? Number(value) : value;
  return typeof number === 'number' && Number.isFinite(number) ? number : null;
}

/**
 * Formats an entry, a number with up to five significant digits.
 * @param {unknown} value
 */
export function entryText(value) {
  if (typeof value === 'number') return String(Number(value.toPrecision(5))).replaceAll('-', '−');
  return String(value ?? '–');
}

/** Whether a value is the address of a page, such as that of a run. @param {unknown} value */
export const isAddress = (value) => typeof value === 'string' && /^https?:\/\//.test(value);

/**
 * Entries named like a column of the row get the prefix `provenance.`.
 * @param {ExperimentRow} row
 * @param {Record<string, Entry>} entries
 */
const named = (row, entries) =>
  Object.fromEntries(
    Object.entries(entries).map(([name, value]) => [
      name in row || name in row.components ? `provenance.${name}` : name,
      value,
    ]),
  );

/**
 * @param {Record<string, unknown>} tree
 * @param {string} [prefix]
 * @returns {Record<string, Entry>}
 */
function flattened(tree, prefix = '') {
  return Object.assign(
    {},
    ...Object.entries(tree).map(([key, value]) => {
      if (value && typeof value === 'object' && !Array.isArray(value))
        return flattened(/** @type {Record<string, unknown>} */ (value), `${prefix}${key}.`);
      return { [`${prefix}${key}`]: Array.isArray(value) ? JSON.stringify(value) : value };
    }),
  );
}
