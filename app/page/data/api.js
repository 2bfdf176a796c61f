/** What the page asks of its server over HTTP (docs/api.md). */

import { begun } from './live_stream.js';
import { Trace } from './trace.js';

/**
 * @typedef {{name: string, unit: 'm' | 'rad'}} Component
 * @typedef {{index: number, steps: number, policy: string, split: string, seed: number, contact_fraction: number}} Summary
 * @typedef {object} Task
 * @property {string} name @property {Component[]} components @property {string[]} modalities @property {number} dt s
 * @property {{x: string, y: string, half_width: number}} map
 * @property {{name: string, kind: string, checkpoint_hash: string, live?: string}[]} filters `live`: known only by the live run of that name
 * @property {{name: string, first: number, episodes: Summary[], live?: import('../tabs/live_runs.js').Run}[]} data sets of episodes; the index to begin with
 * @property {{name: string, faults: string}[]} fault_presets
 * @typedef {{name: string, default: number | string | null, unit: string, meaning: string}} Parameter
 * @typedef {{fault: string, meaning: string, parameters: Parameter[]}} Fault
 * @typedef {{version: string, tasks: Task[], faults: Fault[], problems?: string[]}} Catalog
 * @typedef {{task: string, filter: string, data: string, episode: number, faults: string, against?: string}} Selection names of what is looked at;
 *   `against` makes it the other run that it is compared with, by what differs
 * @typedef {{name: string, url: string, bytes: number, seconds: number | null}} Recording seconds: null if it was there
 */

const AGAIN = 150; // ms until a trace that is being computed is asked for again
const RECORDED_MAPS = 40; // sets of maps that a recording holds: a few seconds to compute

/** An answer that says what is wrong, in a line that a person can read. */
export class ServerError extends Error {}

/** @param {string} url @param {RequestInit} [options] @returns {Promise<Response>} Raises ServerError. */
async function ask(url, options) {
  let response;
  try {
    response = await fetch(url, options);
  } catch (error) {
    if (error.name === 'AbortError') throw error;
    throw new ServerError('The server does not answer. Is `beliefscope serve` still running?');
  }
  if (response.ok) return response;
  const body = await response.json().catch(() => ({}));
  throw new ServerError(body.error ?? `The server answered ${response.status} ${response.statusText}.`);
}

const post = (url, body, method = 'POST') =>
  ask(url, { method, headers: { 'content-type': 'application/json' }, body: JSON.stringify(body) });

/** @returns {Promise<Catalog>} */
export const catalog = async () => (await ask('/api/catalog')).json();

/** @returns {Promise<{runs: import('../tabs/live_runs.js').Run[], tasks: Task[]}>} live runs, the newest first; the tasks that they are of. */
export const liveRuns = async () => (await ask('/api/live')).json();

/** @param {boolean} dark @returns {Promise<{view: string, scene: string, socket: string}>} */
export const openView = async (dark) => (await post('/api/views', { dark })).json();

/** Raises ServerError where there is no such trace: an unknown name, or a faults that cannot be. @param {Selection} selection */
export const check = (selection) => ask(traceUrl(selection));

const traceUrl = ({ task, filter, data, episode, faults, against }, part = '') =>
  `/api/trace/${encodeURIComponent(task)}/${encodeURIComponent(filter)}/${episode}${part}?${new URLSearchParams({ data, faults, ...(against && { against }) })}`;

/** A run and the other one side by side. @param {Selection} selection with `against` @returns {Promise<Found & {names: [string, string]}>} */
export const comparison = ({ task, filter, data, episode, faults, against }, signal) =>
  whole(`/api/compare/${encodeURIComponent(task)}/${encodeURIComponent(filter)}/${episode}?${new URLSearchParams({ data, faults, against })}`, signal);

/**
 * A trace with all its numbers and pictures; the server computes it first if need be.
 * @param {Task} task @param {Selection} selection
 * @param {(share: number) => void} progress @param {AbortSignal} signal
 * @returns {Promise<Trace>}
 */
export async function loadTrace(task, selection, progress, signal) {
  const there = async (part) => {
    let response = await ask(traceUrl(selection, part), { signal });
    while (response.status === 202) {
      progress((await response.json()).progress);
      await new Promise((resolve) => setTimeout(resolve, AGAIN));
      response = await ask(traceUrl(selection, part), { signal });
    }
    return response;
  };
  const header = await (await there()).json();
  if (header.live) return begun(task, selection, header, signal);
  const buffer = async (part) => (await there(part)).arrayBuffer();
  const [columns, pictures] = await Promise.all([buffer('/columns'), header.pictures && buffer('/images')]);
  return new Trace(task, selection, header, columns, pictures);
}

/**
 * @typedef {{name: string, title: string, question: string, slow: boolean, why_not: string | null,
 *   options: {name: string, meaning: string, default: string}[]}} Entry of the catalog of diagnostics, for one trace
 * @typedef {{id: string, kind: string, title: string, state: string, progress: number, message: string, error: string, link: string,
 *   asked: number, started: number | null, ended: number | null}} Job
 * @typedef {{verdict: string, trajectories: number, tables: object[], curves: object[], bands: object, plots: object[], pictures: object[]}} Found
 */

const diagnosticUrl = ({ task, filter, data, episode, faults }, name, query = {}) =>
  `/api/diagnostics/${name ? `${encodeURIComponent(name)}/` : ''}${encodeURIComponent(task)}/${encodeURIComponent(filter)}/${episode}?${new URLSearchParams({ data, faults, ...query })}`;

/** All diagnostics, and why those that do not apply do not. @returns {Promise<Entry[]>} */
export const diagnostics = (selection, signal) => whole(diagnosticUrl(selection), signal);

/** One diagnostic: what it found; or the job that finds it, null where nobody asked for it.
 *  @param {Record<string, string>} query its options, and `episodes` @returns {Promise<Found | {job: Job | null}>} */
export const diagnostic = (selection, name, query, signal) => whole(diagnosticUrl(selection, name, query), signal);

/** Has a diagnostic computed as a job. @returns {Promise<{job: Job}>} */
export const compute = async (selection, name, query) => (await ask(diagnosticUrl(selection, name, query), { method: 'POST' })).json();

/** Asks again while the trace that it is of is computed. */
async function whole(url, signal) {
  for (;;) {
    const body = await (await ask(url, { signal })).json();
    if (!('progress' in body)) return body;
    await new Promise((resolve) => setTimeout(resolve, AGAIN));
  }
}

/**
 * @typedef {{episode: number, step: number, first: number, last: number, value: number, group: string, also: string[],
 *   error: (number | null)[], nees: number | null, ess: number | null, acting: number[] | null, link: string}} Moment
 * @typedef {object} Failures where a filter fails over a data set (docs/api.md) @property {string[]} layers
 * @property {{name: string, title: string, unit: string, why_not: string | null, verdict?: string, total?: number,
 *   counts?: Record<string, number>, groups?: object[], moments?: Moment[]}[]} scores
 * @property {{index: number, steps: number, rmse: number, worst: number, worst_step: number, error: number[], contact: boolean[]}[]} episodes
 */

const failuresUrl = ({ task, filter, data, faults, among }) =>
  `/api/failures/${encodeURIComponent(task)}/${encodeURIComponent(filter)}?${new URLSearchParams({ data, faults, among })}`;

/** Where a filter fails; or the job that looks for it, null where nobody asked for it. @returns {Promise<Failures | {job: Job | null}>} */
export const failures = (asked, signal) => whole(failuresUrl(asked), signal);

/** Has it looked for as a job. @returns {Promise<{job: Job}>} */
export const lookForFailures = async (asked) => (await ask(failuresUrl(asked), { method: 'POST' })).json();

/** What the workspace keeps of recordings, and of reports (docs/api.md). */
export const recordings = async () => (await ask('/api/recordings')).json();
export const reports = async () => (await ask('/api/reports')).json();

/** Gives a recording another name, or other tags, or keeps it. @param {{url: string}} file @param {{name?: string, tags?: string[], automatic?: false}} change */
export const changeRecording = async ({ url }, change) => (await post(url, change, 'PATCH')).json();

/** Has a recording read as a run of this workspace; the job's link opens it. @returns {Promise<{job: Job}>} */
export const readRun = async ({ url }) => (await ask(`${url}/run`, { method: 'POST' })).json();

/** Puts a recording or a report into the trash. @returns {Promise<{deleted: string}>} by which it is had back */
export const discard = async ({ url }) => (await ask(url, { method: 'DELETE' })).json();

/** Has it back. @param {'recordings' | 'reports'} of */
export const restore = async (of, id) => (await ask(`/api/${of}/deleted/${encodeURIComponent(id)}`, { method: 'POST' })).json();

/** Deletes for good what is in the trash. @returns {Promise<{freed: number}>} bytes */
export const emptyTrash = async (of) => (await ask(`/api/${of}/deleted`, { method: 'DELETE' })).json();

/** @returns {Promise<Job[]>} the newest first. */
export const jobs = async () => (await ask('/api/jobs')).json();

/** A job with its log. @returns {Promise<Job & {log: string}>} */
export const job = async (id) => (await ask(`/api/jobs/${id}`)).json();

/** Cancels a job that is under way, forgets one that has ended. @returns {Promise<Job>} */
export const cancel = async (id) => (await ask(`/api/jobs/${id}`, { method: 'DELETE' })).json();

/** Has a report of a run made. The job's link is where it lies. @param {{moments: number[], every: boolean, pdf: boolean, title: string}} wanted @returns {Promise<{job: Job}>} */
export const report = async ({ task, filter, episode, data, faults }, wanted) =>
  (await post(`/api/reports/${encodeURIComponent(task)}/${encodeURIComponent(filter)}/${episode}?${new URLSearchParams({ data, faults })}`, wanted)).json();

/** What is asked for to record a trace, with maps at even steps. @param {Trace} trace @param {boolean} automatic whether it is to be looked at only */
export const recorded = (trace, automatic = false) => ({ ...trace.selection, maps: Math.ceil(trace.steps / RECORDED_MAPS), automatic });

/** Writes a recording; the job that makes it where that takes long: ask again when that is done. @returns {Promise<Recording | {job: Job}>} */
export const record = async (asked) => (await post('/api/recordings', asked)).json();

/**
 * @typedef {object} Run of fine-tuning (docs/api.md) @property {string} run @property {string} task @property {string} filter
 * @property {object} settings @property {Job | null} job @property {string | null} child @property {'kept' | 'default' | null} place
 */

const finetuneUrl = ({ task, filter, data }) => `/api/finetune/${encodeURIComponent(task)}/${encodeURIComponent(filter)}?${new URLSearchParams({ data })}`;

/** What of a filter can be trained, on what, and the runs so far. */
export const finetuning = async (selection, signal) => (await ask(finetuneUrl(selection), { signal })).json();

/** Has it trained further, or goes on with the run of the same settings. @returns {Promise<Run>} */
export const startFinetune = async (selection, settings) => (await post(finetuneUrl(selection), settings)).json();

/** A run, how far it is, and what it found. */
export const tuned = async (run, signal) => (await ask(`/api/tuned/${encodeURIComponent(run)}`, { signal })).json();

/** Which filters of a task were made from which. @returns {Promise<{members: object[]}>} */
export const lineage = async (task, signal) => (await ask(`/api/lineage/${encodeURIComponent(task)}`, { signal })).json();

/** What studies found. @returns {Promise<{studies: object[], problems: string[]}>} */
export const studies = async () => (await ask('/api/studies')).json();

/** Has a study's cells trained that are not yet. @returns {Promise<{job: Job}>} */
export const runCells = async (study) => (await ask(`/api/studies/${encodeURIComponent(study)}/cells`, { method: 'POST' })).json();

/** Puts a checkpoint that a study measured on the shelf. @returns {Promise<{filter: string}>} its name there */
export const openMeasured = async (...parts) => (await ask(`/api/studies/${parts.map(encodeURIComponent).join('/')}`, { method: 'POST' })).json();

/** What becomes of a child. @param {'accept' | 'keep' | 'roll-back'} act @returns {Promise<Run>} */
export const decide = async (run, act) => (await ask(`/api/tuned/${encodeURIComponent(run)}/${act}`, { method: 'POST' })).json();
