/** Groups of the rows of a sweep: mean and spread over training seeds, and the level of their sensor faults. */

/** @import { ExperimentRow } from '../types/server.js' */

import { entryText, isResult, isSeed, numberIn, provenanceOf } from './experiment_provenance.js';
import { numberOf, numbersOf, rowKey } from './experiment_rows.js';

/**
 * A row for several checkpoints: its numbers are means over them.
 * @typedef {ExperimentRow & {members: ExperimentRow[], spread: Record<string, number>}} SeedGroup
 */

const COUNTS = ['episodes', 'steps']; // numbers without a spread over seeds

/**
 * Joins the checkpoints with equal filter, training and values of the named entries of the provenance.
 * Numbers are means over the checkpoints, and `spread` their sample standard deviations.
 * @param {ExperimentRow[]} rows
 * @param {string[]} entries
 * @returns {SeedGroup[]}
 */
export function seedGroups(rows, entries) {
  /** @type {Map<string, ExperimentRow[]>} */
  const groups = new Map();
  const settings = new Map(rows.map((row) => [row, settingsOf(row, entries)]));
  for (const [row, text] of settings) {
    const key = JSON.stringify([text, row.task, row.data, row.faults]);
    if (!groups.get(key)?.push(row)) groups.set(key, [row]);
  }
  const names = namesOf([...settings.values()]);
  const numbers = Object.keys(numbersOf(rows));
  return [...groups.values()].map((unsorted) => {
    // The first checkpoint identifies the group, whatever the order of the rows.
    const members = unsorted.sort((a, b) => a.checkpoint.localeCompare(b.checkpoint));
    const [first] = members;
    /** @type {Record<string, number | null>} */
    const means = {};
    /** @type {Record<string, number>} */
    const spread = {};
    for (const key of numbers) {
      const moments = meanAndSpread(members, key);
      means[key] = moments.mean;
      if (!COUNTS.includes(key) && members.length > 1) spread[key] = moments.spread;
    }
    const components = Object.fromEntries(
      Object.keys(first.components).map((key) => [key, means[key]]),
    );
    const name = names.get(settings.get(first) ?? '') ?? first.filter;
    const row = /** @type {ExperimentRow} */ ({ ...first, ...means, components });
    return { ...row, name, spread, members };
  });
}

/**
 * Whether several checkpoints of a group have the same seed, so that they differ in something else.
 * @param {ExperimentRow | SeedGroup} row
 */
export function repeatsSeed(row) {
  const seeds = 'members' in row ? row.members.map(seedOf).filter(Boolean) : [];
  return new Set(seeds).size < seeds.length;
}

/** Seeds of the training, as text; empty without any. @param {ExperimentRow} row */
function seedOf(row) {
  const { finetuned, plan } = entriesOf(row.training);
  const recorded = Object.entries(provenanceOf(row)).filter(([name]) => isSeed(name));
  const seeds = [...recorded.sort(), finetuned?.seed, plan?.seed].filter((seed) => seed != null);
  return seeds.length ? JSON.stringify(seeds) : '';
}

/** Identifies a displayed row: a checkpoint, or a group by its first one. @param {ExperimentRow | SeedGroup} row */
export const cellOf = (row) => `${'members' in row ? 'seeds.' : ''}${rowKey(row)}`;

/**
 * Kinds of the sensor faults that have levels: those of `blackout=0.4` and `blackout=0.8` are of the kind `blackout`.
 * @param {ExperimentRow[]} rows
 */
export const faultKinds = (rows) =>
  [...new Set(rows.map(({ faults }) => levelOf(faults)?.kind))].filter(
    (kind) => kind !== undefined,
  );

/**
 * Level of a row's sensor faults: 0.4 for `blackout=0.4`, 0 without faults; null for faults of another kind.
 * @param {ExperimentRow} row
 * @param {string} kind
 */
export function faultLevel({ faults }, kind) {
  if (!faults) return 0;
  const fault = levelOf(faults);
  return fault?.kind === kind ? fault.level : null;
}

/** Splits a single fault at its last number, apart from its first and last step. @param {string} faults */
function levelOf(faults) {
  const [, fault, steps] = faults.match(/^([^,]*?)((?::(?:from|to)=\d+)*)$/) ?? [];
  const [, kind, level] = fault?.match(/^(.*?)=?(-?\d+(?:\.\d+)?)$/) ?? [];
  return kind === undefined ? undefined : { kind: kind + steps, level: Number(level) };
}

/**
 * Filter, and the settings of its training without the seed, as text.
 * @param {ExperimentRow} row
 * @param {string[]} entries of the provenance that are settings
 */
function settingsOf(row, entries) {
  const { finetuned, plan, ...trained } = entriesOf(row.training);
  const { seed: _, ...tuning } = finetuned ?? {};
  const provenance = provenanceOf(row);
  const settings = [
    ...entries.map((name) => [name, numberIn(provenance[name]) ?? provenance[name] ?? null]),
    ...(finetuned ? [[FINE_TUNING, tuning]] : []),
    ...Object.entries(trained).sort(),
    ...Object.entries(plan ?? {}).sort(),
  ];
  const isSet = (/** @type {any} */ value) => value !== null && value?.length !== 0;
  return JSON.stringify([
    row.filter,
    settings.filter(([key, value]) => key !== 'seed' && isSet(value)),
  ]);
}

/** @param {string} text JSON of an object @returns {Record<string, any>} */
const entriesOf = (text) => JSON.parse(text || '{}');

/**
 * Names of the groups by their settings: the filter, and the fewest settings, up to MOST_LABELS, that distinguish the
 * groups of the filter.
 * @param {string[]} texts of the settings
 */
function namesOf(texts) {
  /** Settings of each filter. @type {Map<string, Map<string, Map<string, unknown>>>} */
  const filters = new Map();
  for (const text of new Set(texts)) {
    const [filter, settings] = /** @type {[string, [string, unknown][]]} */ (JSON.parse(text));
    filters.set(filter, (filters.get(filter) ?? new Map()).set(text, new Map(settings)));
  }
  /** @type {Map<string, string>} */
  const names = new Map();
  for (const [filter, groups] of filters) {
    const keys = distinguishing([...groups.values()]);
    for (const [text, settings] of groups) {
      const labels = keys.filter((key) => settings.has(key));
      names.set(text, [filter, ...labels.map((key) => labelOf(key, settings.get(key)))].join(', '));
    }
  }
  return names;
}

const MOST_LABELS = 3;
const LONGEST_VALUE = 24; // characters of a setting in the name of a group
const FINE_TUNING = 'fine-tuning';

/**
 * Keys of settings that distinguish the groups; each divides them into as many parts as possible. Results of the
 * training are the last resort.
 * @param {Map<string, unknown>[]} groups
 */
function distinguishing(groups) {
  const all = [...new Set(groups.flatMap((settings) => [...settings.keys()]))];
  /** @type {string[]} */
  const keys = [];
  const parts = (/** @type {string[]} */ names) =>
    new Set(groups.map((settings) => JSON.stringify(names.map((name) => settings.get(name))))).size;
  for (let count = parts(keys); keys.length < MOST_LABELS && count < groups.length;) {
    const options = all
      .map((key) => ({ key, count: parts([...keys, key]), isLast: Number(isResult(key)) }))
      .filter((option) => option.count > count)
      .sort((a, b) => a.isLast - b.isLast || b.count - a.count);
    keys.push(options[0].key);
    count = options[0].count;
  }
  return keys;
}

/**
 * @param {string} key
 * @param {unknown} value
 */
function labelOf(key, value) {
  if (key === FINE_TUNING) return 'fine-tuned';
  const text = typeof value === 'object' ? JSON.stringify(value) : entryText(value);
  return `${key} ${key === 'data' ? text.slice(0, 8) : text.slice(0, LONGEST_VALUE)}`;
}

/**
 * Mean and sample standard deviation of the known values; null without any, spread 0 of a single one.
 * @param {ExperimentRow[]} rows
 * @param {string} key of a number
 */
function meanAndSpread(rows, key) {
  const values = rows.map((row) => numberOf(row, key)).filter((value) => value !== null);
  if (!values.length) return { mean: null, spread: 0 };
  const mean = values.reduce((sum, value) => sum + value, 0) / values.length;
  const squares = values.reduce((sum, value) => sum + (value - mean) ** 2, 0);
  return { mean, spread: values.length > 1 ? Math.sqrt(squares / (values.length - 1)) : 0 };
}
