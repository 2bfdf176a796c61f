/** The provenance of the checkpoints of a sweep, such as their training settings, as columns. */

/** @import { ExperimentRow } from '../types/server.js' */
/** @import { SeedGroup } from './experiment_groups.js' */

/** @typedef {string | number | boolean | null} Entry */

const MOST_COLUMNS = 100;

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

/**
 * Names of the entries that differ between rows, in the order of the rows.
 * @param {ExperimentRow[]} rows
 */
export function differingEntries(rows) {
  /** @type {Map<string, Set<Entry>>} */
  const values = new Map();
  for (const row of rows)
    for (const name of Object.keys(provenanceOf(row)))
      values.set(name, values.get(name) ?? new Set());
  for (const row of rows)
    for (const [name, set] of values) set.add(provenanceOf(row)[name] ?? null);
  return [...values.keys()]
    .filter((name) => Number(values.get(name)?.size) > 1)
    .slice(0, MOST_COLUMNS);
}

/**
 * Whether all values of an entry are numbers or missing.
 * @param {ExperimentRow[]} rows
 * @param {string} name
 */
export const isNumeric = (rows, name) =>
  rows.every((row) => typeof (provenanceOf(row)[name] ?? 0) === 'number');

/**
 * Formats an entry, a number with up to five significant digits.
 * @param {unknown} value
 */
export function entryText(value) {
  if (typeof value === 'number') return String(Number(value.toPrecision(5))).replaceAll('-', '−');
  return String(value ?? '–');
}

/** Whether an entry is a random seed: `seed`, or `data.seed` of nested entries. @param {string} name */
export const isSeed = (name) => name.split('.').at(-1) === 'seed';

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
      name in row ? `provenance.${name}` : name,
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
