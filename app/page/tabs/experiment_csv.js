/** The displayed table of the Experiments tab as CSV. */

/** @import { ExperimentRow } from '../types/server.js' */
/** @import { Column } from './experiment_columns.js' */
/** @import { SeedGroup } from './experiment_groups.js' */

import { csv } from '../core/download.js';
import { faultsText, valueOf } from './experiment_rows.js';

/** @typedef {{title: string, value: (row: ExperimentRow | SeedGroup) => unknown}} Field */

/**
 * Writes the rows and columns as displayed, with all digits of the numbers. The standard deviations of groups, and the
 * unit of results in several units, are columns of their own.
 * @param {(ExperimentRow | SeedGroup)[]} rows
 * @param {Column[]} columns
 */
export function tableCsv(rows, columns) {
  const fields = columns.flatMap((column) => fieldsOf(rows, column));
  if (new Set(rows.map(({ unit }) => unit)).size > 1)
    fields.push({ title: 'unit', value: ({ unit }) => unit });
  const titles = fields.map(({ title }) => title);
  return csv([titles, ...rows.map((row) => fields.map(({ value }) => value(row)))]);
}

/**
 * @param {(ExperimentRow | SeedGroup)[]} rows
 * @param {Column} column
 * @returns {Field[]}
 */
function fieldsOf(rows, { key, title }) {
  /** @param {ExperimentRow | SeedGroup} row */
  const value = (row) => {
    if (key === 'seeds') return 'members' in row ? row.members.length : 1;
    return key === 'faults' ? faultsText(row.faults) : valueOf(row, key);
  };
  /** @param {ExperimentRow | SeedGroup} row */
  const spread = (row) => ('spread' in row ? row.spread[key] : undefined);
  const hasSpread = rows.some((row) => spread(row) !== undefined);
  return [
    { title, value },
    ...(hasSpread ? [{ title: `${title}, standard deviation`, value: spread }] : []),
  ];
}
