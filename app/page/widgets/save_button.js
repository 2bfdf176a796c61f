/** "Save .rrd": writes a recording, shows the progress and downloads the file; resumes after a reload. */

/** @import { RecordingRequest } from '../data/api.js' */
/** @import { Job, WrittenRecording } from '../types/server.js' */
/** @import { Jobs } from './jobs.js' */

import { create, createButton, messageOf } from '../core/dom.js';
import { fixed, formatBytes, percent } from '../core/units.js';
import * as api from '../data/api.js';
import { jobSummary } from './jobs.js';

const PENDING_REQUEST = 'recording'; // key in the session storage

/**
 * Has a recording written and waits until it is complete. Throws ServerError.
 * @param {RecordingRequest} request
 * @param {Jobs} jobs one of them computes the maps
 * @param {(job: Job) => void} progress
 * @returns {Promise<WrittenRecording>}
 */
export async function writeRecording(request, jobs, progress) {
  const reply = await api.createRecording(request);
  if (!('job' in reply)) return reply;
  progress(reply.job);
  const job = await jobs.ended(reply.job.id, progress);
  if (job?.state !== 'done')
    throw new api.ServerError(job ? jobSummary(job) : 'The job was removed.');
  const recording = await api.createRecording(request);
  if ('job' in recording) throw new api.ServerError('The recording was deleted.');
  return { ...recording, seconds: Number(job.ended) - Number(job.started) };
}

/**
 * Connects the button.
 * @param {HTMLButtonElement} button
 * @param {HTMLElement} host of the result
 * @param {Jobs} jobs
 * @param {object} actions
 * @param {() => RecordingRequest | null} actions.request null while there is no run
 * @param {() => void} actions.openRerun shows the run in the Rerun tab
 * @param {(name: string) => void} actions.openRecordings shows the file in the Recordings tab
 * @returns {() => Promise<void>} saves the run
 */
export function connectSaveButton(button, host, jobs, { request, openRerun, openRecordings }) {
  /** @param {...(Node | string)} children */
  const show = (...children) => {
    const close = createButton('', '×', () => host.replaceChildren(), { ariaLabel: 'Dismiss' });
    host.replaceChildren(create('p', {}, ...children, close));
  };
  let isWriting = false;
  /** @param {RecordingRequest | null} body */
  const save = async (body) => {
    if (isWriting || !body) return;
    isWriting = true;
    sessionStorage.setItem(PENDING_REQUEST, JSON.stringify(body));
    [button.disabled, button.textContent] = [true, 'Writing …'];
    const progress = create('progress', { ariaLabel: 'Progress of the recording', hidden: true });
    const cancel = createButton('text', 'Cancel', () => jobs.cancel(cancel.value));
    cancel.hidden = true;
    show('Writing the recording …', progress, cancel);
    try {
      const recording = await writeRecording(body, jobs, ({ id, progress: share }) => {
        [progress.value, cancel.value, button.textContent] = [share, id, percent(share)];
        progress.hidden = cancel.hidden = false;
      });
      const { name, url, bytes, seconds } = recording;
      const link = create('a', { href: url, download: name, textContent: name });
      const duration = seconds === null ? 'written earlier' : `written in ${fixed(seconds)} s`;
      /** @param {() => void} open */
      const leave = (open) => () => (host.replaceChildren(), open());
      show(
        link,
        ` ${formatBytes(bytes)}, ${duration} `,
        createButton('text', 'Open in Rerun tab', leave(openRerun)),
        createButton(
          'text',
          'Recordings',
          leave(() => openRecordings(name)),
        ),
      );
      link.click();
    } catch (error) {
      show(`The recording was not written: ${messageOf(error)}`);
    } finally {
      sessionStorage.removeItem(PENDING_REQUEST);
      isWriting = false;
      [button.disabled, button.textContent] = [!request(), 'Save .rrd'];
    }
  };
  const saveDisplayed = () => save(button.disabled ? null : request());
  button.addEventListener('click', saveDisplayed);
  const unfinished = sessionStorage.getItem(PENDING_REQUEST);
  if (unfinished) save(JSON.parse(unfinished));
  return saveDisplayed;
}
