/** Columns of the table of the Experiments tab. */

/** @import { ExperimentRow } from '../types/server.js' */
/** @import { SeedGroup } from './experiment_groups.js' */
/** @typedef {{rows: string, groups: string, pinned: string}} TableState of the page's state */
/** @typedef {{columns: Column[], entries: string[], count: number, grouping: string[], pinned: string[]}} TableLayout */

import { displayName } from '../core/units.js';
import { repeatsSeed } from './experiment_groups.js';
import { groupEntries, namesIn } from './experiment_group_menu.js';
import { differingEntries, entryText, isNumeric } from './experiment_provenance.js';
import { faultsText, numberOf, numbersOf, valueOf } from './experiment_rows.js';

/** @type {Column} */
const SEEDS = {
  key: 'seeds',
  title: 'seeds',
  help: 'Number of checkpoints; ± is their standard deviation. Repeated: several have the same seed, so they differ in something else',
  number: true,
  content: (row) =>
    `${'members' in row ? row.members.length : 1}${repeatsSeed(row) ? ', repeated' : ''}`,
};
/** @typedef {{key: string, title: string, help: string, number: boolean, content: (row: ExperimentRow | SeedGroup) => string}} Column */

const MOST_ENTRIES = 100;

/**
 * Entries of the provenance that are columns, the pinned and the first others, and the number of differing entries.
 * @param {ExperimentRow[]} rows
 * @param {string[]} pinned keys of columns
 */
export function entryColumns(rows, pinned) {
  const entries = differingEntries(rows);
  const isPinned = (/** @type {string} */ name) => pinned.includes(name);
  const first = [...entries.filter(isPinned), ...entries.filter((name) => !isPinned(name))];
  const listed = new Set(first.slice(0, MOST_ENTRIES));
  return { entries: entries.filter((name) => listed.has(name)), count: entries.length };
}

/**
 * Columns of the table, the pinned ones first; texts that are equal in all rows are left out.
 * @param {ExperimentRow[]} rows
 * @param {boolean} areGroups whether each displayed row is a mean over checkpoints
 * @param {string[]} entries of the provenance
 * @param {string[]} pinned keys of the columns beside the first one
 * @returns {Column[]}
 */
export function columnsOf(rows, areGroups, entries, pinned) {
  const units = [...new Set(rows.map(({ unit }) => unit))];
  const texts = /** @type {const} */ (['filter', 'task', 'faults']).filter(
    (key) => new Set(rows.map((row) => row[key])).size > 1 && !(areGroups && key === 'filter'),
  );
  /** @type {Column[]} */
  const [first, ...others] = [
    {
      key: 'name',
      title: areGroups ? 'filter' : 'checkpoint',
      help: areGroups ? 'Filter, and the settings that distinguish its groups' : 'Name of the file',
      number: false,
      content: ({ name }) => name,
    },
    ...texts.map((key) => ({
      key,
      title: key,
      help: displayName(key),
      number: false,
      content: (/** @type {ExperimentRow} */ row) => faultsText(row[key]),
    })),
    ...(areGroups ? [SEEDS] : []),
    ...Object.entries(numbersOf(rows)).map(([key, { title, help, hasUnit, format }]) => ({
      key,
      title: hasUnit && units.length === 1 ? `${title}, ${units[0]}` : title,
      help,
      number: true,
      content: (/** @type {ExperimentRow | SeedGroup} */ row) => {
        const spread = 'spread' in row ? row.spread[key] : undefined;
        const more = spread === undefined ? '' : ` ± ${format(spread)}`;
        return `${format(numberOf(row, key))}${more}${hasUnit && units.length > 1 ? ` ${row.unit}` : ''}`;
      },
    })),
    ...entries.map((name) => ({
      key: name,
      title: name,
      help: `${name} in the provenance of the checkpoint`,
      number: isNumeric(rows, name),
      content: (/** @type {ExperimentRow} */ row) => entryText(valueOf(row, name)),
    })),
  ];
  const at = (/** @type {Column} */ { key }) => pinned.indexOf(key) >>> 0; // those not pinned last, in their order
  return [first, ...others.sort((a, b) => at(a) - at(b))];
}

/**
 * Returns a function from the rows and the state to the columns, the entries of the provenance that are columns, the
 * number of differing entries, and the entries that distinguish groups. For the same rows and choices, such as while
 * the filter of the rows is typed, its last result is returned again.
 * @returns {(rows: ExperimentRow[], state: TableState) => TableLayout}
 */
export function tableLayout() {
  /** @type {ExperimentRow[] | null} */
  let lastRows = null;
  let lastChoices = '';
  /** @type {TableLayout} */
  let layout;
  return (rows, { rows: mode, groups, pinned: names }) => {
    const choices = JSON.stringify([mode, groups, names]);
    if (rows === lastRows && choices === lastChoices) return layout;
    const pinned = namesIn(names);
    const grouping = groupEntries(rows, groups);
    const { entries, count } = entryColumns(rows, pinned);
    const areGroups = mode === 'seeds';
    const columns = columnsOf(rows, areGroups, areGroups ? grouping : entries, pinned);
    layout = { columns, entries, count, grouping, pinned };
    [lastRows, lastChoices] = [rows, choices];
    return layout;
  };
}
