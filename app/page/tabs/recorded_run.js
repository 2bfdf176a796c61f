/** Runs in recordings and reports: their selection on the page, and the comparison of two of them. */

/** @import { State } from '../core/state.js' */
/** @import { Catalog, RecordingEntry, ReportEntry } from '../types/server.js' */

import { hasEpisode } from '../core/episodes.js';

/** @typedef {Pick<State, 'task' | 'filter' | 'data' | 'episode' | 'faults'>} Run */

/**
 * Returns the run of a recording; null if the catalog does not contain it.
 * @param {RecordingEntry} recording
 * @returns {Run | null}
 */
export function recordedRun({ task, episode, faults, run }) {
  return run && task !== null && episode !== null ? { task, episode, faults, ...run } : null;
}

/** @type {(keyof Run)[]} */
const RUN_KEYS = ['task', 'filter', 'data', 'episode', 'faults'];

/**
 * Returns whether two selections are of the same run.
 * @param {Run} run
 * @param {Run} other
 */
export const isSameRun = (run, other) => RUN_KEYS.every((key) => run[key] === other[key]);

/**
 * Returns the changes of the state that open recordings in the Rerun tab. The page shows the run of a single recording
 * with it, if this server has that run.
 * @param {Catalog} catalog
 * @param {State} state
 * @param {RecordingEntry[]} files
 * @returns {Partial<State>}
 */
export function openRecordings(catalog, state, files) {
  const run = files.length === 1 ? recordedRun(files[0]) : null;
  const isNew = run && !isSameRun(run, state);
  return {
    ...(isNew ? selectRun(catalog, state, run) : {}),
    recording: files.map(({ name }) => name).join('/'),
    tab: 'rerun',
    playing: false,
  };
}

/**
 * Describes opened files, and how they relate to the rest of the page.
 * @param {Pick<RecordingEntry, 'name' | 'task' | 'filter' | 'episode' | 'application'>[]} files
 * @param {boolean} isCurrentRun whether the page shows the run of the only file
 * @param {Run} current run of the page
 */
export function describeOpened(files, isCurrentRun, current) {
  const names = files.map(({ name }) => name).join(' and ');
  if (isCurrentRun) return `${names}: the run of this page`;
  const rest = `The rest of the page shows ${describeRun(current)}; its time is separate.`;
  if (files.length > 1) return `${names}. ${rest}`;
  const [{ task, filter, episode, application }] = files;
  const owner = task && filter ? describeRun({ task, filter, episode }) : application;
  return `${names} is another run${owner ? ` (${owner})` : ''}. ${rest}`;
}

/** @param {{task: string, filter: string, episode: number | null}} run */
const describeRun = ({ task, filter, episode }) =>
  [task, filter, episode === null ? '' : `episode ${episode}`].filter(Boolean).join(' · ');

/**
 * Returns the run of a report, or why the catalog does not contain it.
 * @param {Catalog} catalog
 * @param {ReportEntry} report
 * @returns {{run: Run, problem?: undefined} | {run?: undefined, problem: string}}
 */
export function reportedRun(
  catalog,
  { task: name, filter, episode, faults, data, data_hash: hash },
) {
  const task = catalog.tasks.find((item) => item.name === name);
  if (!task?.filters.some((item) => item.name === filter))
    return { problem: `This server has no filter ${filter} for task ${name}.` };
  const set = hash ? data : task.data.find((entry) => hasEpisode(entry, episode))?.name;
  if (!set) return { problem: `No data set of this server has the episode ${episode}.` };
  return { run: { task: name, filter, data: set, episode, faults } };
}

/**
 * Returns the changes of the state that select a run.
 * @param {Catalog} catalog
 * @param {State} state
 * @param {Run} run
 * @returns {Partial<State>}
 */
export function selectRun(catalog, state, run) {
  const isSameTask = state.task === run.task;
  const isSameEpisode = isSameTask && state.data === run.data && state.episode === run.episode;
  const component = catalog.tasks.find(({ name }) => name === run.task)?.map.components[0];
  return {
    ...run,
    ...(isSameTask ? {} : { component }),
    against: '',
    playing: false,
    angle: null,
    step: isSameEpisode ? state.step : 0,
  };
}

/**
 * Returns why the runs of two recordings cannot be compared on the page; empty if they can.
 * @param {RecordingEntry} recording
 * @param {RecordingEntry} other
 */
export function comparisonProblem(recording, other) {
  const [run, comparison] = [recordedRun(recording), recordedRun(other)];
  if (recording.task !== other.task) return 'The tasks differ.';
  if (!run) return `${recording.name}: ${recording.why_not}`;
  if (!comparison) return `${other.name}: ${other.why_not}`;
  if (run.episode !== comparison.episode || run.data !== comparison.data)
    return 'The episodes differ; Rerun can display both.';
  return differences(run, comparison) ? '' : 'The runs are the same.';
}

/**
 * Returns the differences of a comparison run as in the page's address.
 * @param {Run} run
 * @param {Run} comparison
 */
export function differences(run, comparison) {
  const query = new URLSearchParams();
  if (run.filter !== comparison.filter) query.set('filter', comparison.filter);
  if (run.faults !== comparison.faults) query.set('faults', comparison.faults);
  return String(query);
}
