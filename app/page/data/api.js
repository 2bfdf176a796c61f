/** Requests to the server (docs/api.md). */

/** @import { State } from '../core/state.js' */
/** @import { Catalog, Comparison, EpisodeList, EpisodeResults, ExperimentRow, Experiments, FineTuneDetails } from '../types/server.js' */
/** @import { FineTuneOffer, FineTuneRunInfo, Job, JobWithLog, Lineage, LiveList, RecordingEntry, RecordingList } from '../types/server.js' */
/** @import { ReportList, Selection, StartedJob, StudyList, SweepList, Task, TraceDiagnosticInfo, TraceHeader } from '../types/server.js' */
/** @import { Weakness, WrittenRecording } from '../types/server.js' */

import { isAbort, pause } from '../core/dom.js';
import { loadLiveTrace } from './live_stream.js';
import { ServerError } from './server_error.js';
import { Trace } from './trace.js';

export { ServerError };

/** @typedef {Selection & {maps: number, quantity: State['map']}} RecordingRequest maps: steps from one map of the quantity to the next */

const POLL_INTERVAL = 150; // ms
const MAPS_PER_RECORDING = 40; // computed within a few seconds

/**
 * Sends a request. Throws ServerError if it fails.
 * @param {string} url
 * @param {RequestInit} [options]
 * @returns {Promise<Response>}
 */
async function request(url, options) {
  let response;
  try {
    response = await fetch(url, options);
  } catch (error) {
    if (isAbort(error)) throw error;
    throw new ServerError('The server does not respond. Is `beliefscope serve` still running?');
  }
  if (response.ok) return response;
  const body = await response.json().catch(() => ({}));
  throw new ServerError(
    body.error ?? `The server responded with ${response.status} ${response.statusText}.`,
    response.status,
  );
}

/**
 * @param {string} url
 * @param {AbortSignal} [signal]
 */
const get = async (url, signal) => (await request(url, { signal })).json();

/**
 * @param {string} url
 * @param {object} [body] JSON
 * @param {string} [method]
 */
async function send(url, body, method = 'POST') {
  const json = body && {
    headers: { 'content-type': 'application/json' },
    body: JSON.stringify(body),
  };
  return (await request(url, { method, ...json })).json();
}

/**
 * Gets JSON, such as the result of a job or the job itself, and waits while the server computes the trace that it
 * depends on.
 * @param {string} url
 * @param {AbortSignal} [signal]
 */
export async function poll(url, signal) {
  for (;;) {
    const body = await get(url, signal);
    if (!('progress' in body)) return body;
    await pause(POLL_INTERVAL);
  }
}

/**
 * Starts the job that computes the result at an address.
 * @param {string} url
 * @returns {Promise<StartedJob>}
 */
export const startJob = (url) => send(url);

/**
 * Joins parts of a path, encoded, and a query.
 * @param {(string | number)[]} parts
 * @param {Record<string, string> | string[][]} [query]
 */
function path(parts, query) {
  const text = parts.map((part) => encodeURIComponent(part)).join('/');
  return query ? `/api/${text}?${new URLSearchParams(query)}` : `/api/${text}`;
}

/**
 * Gets the catalog.
 * @param {string} [task]
 * @param {string[]} [filters] of the task to include, although only a sweep or a study has them
 * @returns {Promise<Catalog>}
 */
export const catalog = (task, filters = []) =>
  get(
    path(
      ['catalog'],
      task ? [['task', task], ...filters.map((name) => ['filter', name])] : undefined,
    ),
  );

/**
 * @param {string} task
 * @param {string} data
 * @param {{query?: string, first?: number, limit?: number}} part
 * @returns {Promise<EpisodeList>}
 */
export const episodes = (task, data, part) => {
  const texts = Object.entries(part).map(([key, value]) => [key, String(value)]);
  return get(path(['episodes', task], [['data', data], ...texts]));
};

/**
 * Gets the live runs, the newest first, and their tasks.
 * @returns {Promise<LiveList>}
 */
export const liveRuns = () => get('/api/live');

/**
 * Opens a view, which has its own 3D scene.
 * @param {boolean} dark
 * @returns {Promise<{view: string, scene: string, socket: string}>}
 */
export const openView = (dark) => send('/api/views', { dark });

/**
 * @param {Selection} selection
 * @param {string} [part] of the trace
 */
function traceUrl({ task, filter, data, episode, faults, against }, part) {
  const query = { data, faults, ...(against ? { against } : {}) };
  return path(['trace', task, filter, episode, ...(part ? [part] : [])], query);
}

/**
 * Loads the images of a sensor of a trace that the server has computed.
 * @param {Selection} selection
 * @param {string} sensor
 */
export const sensorImages = async (selection, sensor) =>
  (
    await request(`${traceUrl(selection, 'images')}&sensor=${encodeURIComponent(sensor)}`)
  ).arrayBuffer();

/**
 * Loads a file with the charts of the timeline, and waits while the server computes the trace and its comparison run.
 * @param {Selection} selection
 * @param {string} format `svg`, `pdf`, `png` or `csv`
 * @param {string[][]} query charts and how they are displayed (docs/api.md)
 * @returns {Promise<{content: Blob, name: string}>}
 */
export async function timelineFile(selection, format, query) {
  const url = `${traceUrl(selection, `timeline.${format}`)}&${new URLSearchParams(query)}`;
  let response = await request(url);
  while (response.status === 202) {
    await pause(POLL_INTERVAL);
    response = await request(url);
  }
  const [, name = ''] =
    /filename="(.+)"/.exec(response.headers.get('content-disposition') ?? '') ?? [];
  return { content: await response.blob(), name };
}

/**
 * Checks that a trace can be computed. Throws ServerError for an unknown name or an invalid fault injection.
 * @param {Selection} selection
 */
export const checkSelection = (selection) => request(traceUrl(selection));

/**
 * Returns the address of a result for a run.
 * @param {string[]} result
 * @param {Selection} selection
 * @param {Record<string, string>} [query]
 */
const runUrl = (result, { task, filter, data, episode, faults }, query) =>
  path([...result, task, filter, episode], { data, faults, ...query });

/**
 * Compares a run with another one.
 * @param {Selection} selection with `against`
 * @param {AbortSignal} [signal]
 * @returns {Promise<Comparison>}
 */
export const comparison = (selection, signal) =>
  poll(runUrl(['compare'], selection, { against: selection.against ?? '' }), signal);

/**
 * Loads a trace with its columns and images, and waits while the server computes it.
 * @param {Task} task
 * @param {Selection} selection
 * @param {(share: number) => void} progress
 * @param {AbortSignal} signal
 * @returns {Promise<Trace>}
 */
export async function loadTrace(task, selection, progress, signal) {
  /** @param {string} [part] */
  const load = async (part) => {
    let response = await request(traceUrl(selection, part), { signal });
    while (response.status === 202) {
      progress((await response.json()).progress);
      await pause(POLL_INTERVAL);
      response = await request(traceUrl(selection, part), { signal });
    }
    return response;
  };
  /** @type {TraceHeader} */
  const header = await (await load()).json();
  if (header.live) return loadLiveTrace(task, selection, header, header.live, signal);
  /** @param {string} part */
  const buffer = async (part) => (await load(part)).arrayBuffer();
  const [columns, images] = await Promise.all([
    buffer('columns'),
    header.sensors.length ? buffer('images') : null,
  ]);
  return new Trace(task, selection, header, columns, images);
}

/**
 * Lists the diagnostics of a run.
 * @param {Selection} selection
 * @param {AbortSignal} [signal]
 * @returns {Promise<TraceDiagnosticInfo[]>}
 */
export const diagnostics = (selection, signal) => poll(runUrl(['diagnostics'], selection), signal);

/**
 * Returns the address of the result of a diagnostic.
 * @param {Selection} selection
 * @param {string} name
 * @param {Record<string, string>} query options, and `episodes`
 */
export const diagnosticUrl = (selection, name, query) =>
  runUrl(['diagnostics', name], selection, query);

/**
 * Returns the address of the diagnosis of a filter.
 * @param {Selection} selection
 * @param {string} over episodes: `episode` or `held-out`
 */
export const diagnosisUrl = (selection, over) => runUrl(['diagnosis'], selection, { over });

/**
 * Returns the address of the healthy record of a filter, measured from the held-out episodes of a run's data.
 * @param {Selection} run
 * @param {string} healthyFilter runs over the healthy episodes; empty: the filter of the run
 */
export const recordUrl = ({ task, filter, data }, healthyFilter) =>
  path(['healthy-record', task, filter], { data, healthy_filter: healthyFilter });

/**
 * Returns the address of the smallest repair of a run.
 * @param {Selection} selection
 */
export const repairUrl = (selection) => runUrl(['repair'], selection);

/**
 * Returns the address of the failures of a filter over a data set.
 * @param {Pick<State, 'task' | 'filter' | 'data' | 'faults' | 'among'>} query
 */
export const failuresUrl = ({ task, filter, data, faults, among }) =>
  path(['failures', task, filter], { data, faults, among });

/**
 * Lists the recordings of the workspace.
 * @returns {Promise<RecordingList>}
 */
export const recordings = () => get('/api/recordings');

/**
 * Lists the reports of the workspace.
 * @returns {Promise<ReportList>}
 */
export const reports = () => get('/api/reports');

/**
 * Renames a recording.
 * @param {{url: string}} file
 * @param {string} name
 * @returns {Promise<RecordingEntry>}
 */
export const renameRecording = ({ url }, name) => send(url, { name }, 'PATCH');

/**
 * Starts a job that imports the run of a recording; the job's link opens it.
 * @param {{url: string}} file
 * @returns {Promise<StartedJob>}
 */
export const importRun = ({ url }) => send(`${url}/run`);

/**
 * Moves a recording or a report to the trash.
 * @param {{url: string}} file
 * @returns {Promise<{deleted: string}>} ID in the trash
 */
export const deleteFile = ({ url }) => send(url, undefined, 'DELETE');

/**
 * Restores a file from the trash.
 * @param {'recordings' | 'reports'} kind
 * @param {string} id
 */
export const restoreFile = (kind, id) => send(path([kind, 'deleted', id]));

/**
 * Deletes the files in the trash permanently.
 * @param {'recordings' | 'reports'} kind
 * @returns {Promise<{freed: number}>} bytes
 */
export const emptyTrash = (kind) => send(path([kind, 'deleted']), undefined, 'DELETE');

/** @returns {Promise<Job[]>} the newest first */
export const jobs = () => get('/api/jobs');

/**
 * @param {string} id
 * @returns {Promise<JobWithLog>}
 */
export const job = (id) => get(path(['jobs', id]));

/**
 * Cancels a waiting or running job; removes a finished one, unless only active jobs are meant.
 * @param {string} id
 * @param {boolean} onlyActive
 * @returns {Promise<Job>}
 */
export const cancelJob = (id, onlyActive) =>
  send(path(['jobs', id], { only_active: String(onlyActive) }), undefined, 'DELETE');

/** @typedef {{events: number[], slow: boolean, pdf: boolean, title: string}} ReportOptions */

/**
 * Starts a job that writes a report; the job's link opens it.
 * @param {Selection} selection
 * @param {ReportOptions & {quantity: State['map']}} options quantity: of the maps
 * @returns {Promise<StartedJob>}
 */
export const createReport = (selection, options) => send(runUrl(['reports'], selection), options);

/**
 * Returns the request for a recording of a trace, with likelihood maps at regular steps.
 * @param {Trace} trace
 * @param {State['map']} [quantity] of the maps
 * @returns {RecordingRequest}
 */
export const recordingRequest = (trace, quantity = 'likelihood') => ({
  ...trace.selection,
  maps: Math.ceil(trace.steps / MAPS_PER_RECORDING),
  quantity,
});

/**
 * Writes a recording. Returns the job that does it if it takes long; repeat the request once the job is done.
 * @param {RecordingRequest} body
 * @returns {Promise<WrittenRecording | StartedJob>}
 */
export const createRecording = (body) => send('/api/recordings', body);

/** @param {Pick<Selection, 'task' | 'filter' | 'data'>} selection */
const finetuneUrl = ({ task, filter, data }) => path(['finetune', task, filter], { data });

/**
 * Gets the modules and the slices for fine-tuning a filter, and the previous runs.
 * @param {Pick<Selection, 'task' | 'filter' | 'data'>} selection
 * @param {AbortSignal} [signal]
 * @returns {Promise<FineTuneOffer>}
 */
export const finetuneOptions = (selection, signal) => get(finetuneUrl(selection), signal);

/**
 * Gets the weaknesses of a filter that fine-tuning can address, those in the selected run first.
 * @param {Selection} selection
 * @param {AbortSignal} [signal]
 * @returns {Promise<Weakness[]>}
 */
export const weaknesses = (selection, signal) => poll(runUrl(['weaknesses'], selection), signal);

/**
 * Starts fine-tuning, or resumes the run with the same settings.
 * @param {Pick<Selection, 'task' | 'filter' | 'data'>} selection
 * @param {object} settings
 * @returns {Promise<FineTuneRunInfo>}
 */
export const startFinetune = (selection, settings) => send(finetuneUrl(selection), settings);

/**
 * Gets a fine-tuning run with its progress and its results.
 * @param {string} run
 * @param {AbortSignal} [signal]
 * @returns {Promise<FineTuneDetails>}
 */
export const finetuneRun = (run, signal) => get(path(['tuned', run]), signal);

/**
 * Promotes a fine-tuned checkpoint to the default filter, saves it, or discards it.
 * @param {string} run
 * @param {'promote' | 'save' | 'discard'} action
 * @returns {Promise<FineTuneRunInfo>}
 */
export const decideFinetune = (run, action) => send(path(['tuned', run, action]));

/**
 * Gets the fine-tuned checkpoints of a task and their base checkpoints.
 * @param {string} task
 * @param {AbortSignal} [signal]
 * @returns {Promise<Lineage>}
 */
export const lineage = (task, signal) => get(path(['lineage', task]), signal);

/**
 * Lists the studies with their results.
 * @returns {Promise<StudyList>}
 */
export const studies = () => get('/api/studies');

/**
 * Starts a job that trains the remaining cells of a study.
 * @param {string} study
 * @returns {Promise<StartedJob>}
 */
export const trainStudy = (study) => send(path(['studies', study, 'cells']));

/**
 * Adds a checkpoint of a study to the catalog.
 * @param {string} study
 * @param {string} task
 * @param {string} filter
 * @param {string | number} seed
 * @returns {Promise<{filter: string}>} its name in the catalog
 */
export const addStudyFilter = (study, task, filter, seed) =>
  send(path(['studies', study, task, filter, seed]));

/**
 * Lists the sweeps.
 * @returns {Promise<SweepList>}
 */
export const sweeps = () => get('/api/experiments');

/**
 * Gets the results of a sweep by checkpoint, for the steps of one phase.
 * @param {string} sweep
 * @param {string} phase
 * @returns {Promise<Experiments>}
 */
export const experiments = (sweep, phase) => get(path(['experiments', sweep], { phase }));

/**
 * Gets the results of a checkpoint by episode.
 * @param {string} sweep
 * @param {Pick<ExperimentRow, 'checkpoint' | 'data' | 'faults'>} row
 * @param {string} phase
 * @returns {Promise<EpisodeResults>}
 */
export const experimentEpisodes = (sweep, { checkpoint, data, faults }, phase) =>
  get(path(['experiments', sweep, 'episodes'], { checkpoint, data, faults, phase }));

/**
 * Adds a checkpoint of a sweep to the catalog.
 * @param {string} sweep
 * @param {string} checkpoint hash
 * @returns {Promise<{filter: string}>} its name in the catalog
 */
export const addSweepFilter = (sweep, checkpoint) => send(path(['experiments', sweep, checkpoint]));
