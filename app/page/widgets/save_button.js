/** "Save .rrd": has a recording written, says how far it is, and saves it once it is there, also after a reload. */

import * as api from '../data/api.js';
import { told } from './jobs.js';
import { formatBytes, fixed, percent } from '../core/units.js';

const WAITED_FOR = 'recording'; // in this tab's storage: what was asked for, until it is there

/**
 * Has a recording written and waits until it is there. Raises ServerError.
 * @param {object} asked see `api.recordingRequest` @param {import('./jobs.js').Jobs} jobs one of which makes the maps
 * @param {(job: api.Job) => void} say how far it is
 * @returns {Promise<api.Recording>}
 */
export async function written(asked, jobs, say) {
  const made = await api.createRecording(asked);
  if (!made.job) return made;
  say(made.job);
  const job = await jobs.ended(made.job.id, say);
  if (job?.state !== 'done') throw new api.ServerError(job ? told(job) : 'Its job was forgotten.');
  const there = await api.createRecording(asked);
  if (there.job) throw new api.ServerError('It was deleted as soon as it was there.');
  return { ...there, seconds: job.ended - job.started };
}

/**
 * @param {HTMLButtonElement} button @param {HTMLElement} host where the result is told @param {import('./jobs.js').Jobs} jobs
 * @param {() => object | null} wanted see `api.recordingRequest`; null while there is no run
 * @param {() => void} open shows the run in the Rerun tab @param {(name: string) => void} keep shows where the file is among the others
 * @returns {() => Promise<void>} what the button does
 */
export function saving(button, host, jobs, wanted, open, keep) {
  const tell = (...children) => {
    const close = act('×', () => host.replaceChildren(), '');
    close.setAttribute('aria-label', 'Dismiss');
    const line = document.createElement('p');
    line.append(...children, close);
    host.replaceChildren(line);
  };
  const save = async (asked) => {
    if (button.disabled || !asked) return;
    sessionStorage.setItem(WAITED_FOR, JSON.stringify(asked));
    [button.disabled, button.textContent] = [true, 'Writing …'];
    const progress = Object.assign(document.createElement('progress'), {
      ariaLabel: 'Progress of the recording',
      hidden: true,
    });
    const cancel = act('Cancel', () => jobs.cancel(cancel.value));
    cancel.hidden = true;
    tell('Writing the recording …', progress, cancel);
    try {
      const recording = await written(asked, jobs, ({ id, progress: share }) => {
        [progress.value, cancel.value, button.textContent] = [share, id, percent(share)];
        progress.hidden = cancel.hidden = false;
      });
      const link = Object.assign(document.createElement('a'), {
        href: recording.url,
        download: recording.name,
        textContent: recording.name,
      });
      const again = [
        ['Open in Rerun tab', open],
        ['Recordings', () => keep(recording.name)],
      ].map(([text, then]) => act(text, () => (host.replaceChildren(), then())));
      const when =
        recording.seconds === null ? 'written before' : `written in ${fixed(recording.seconds)} s`;
      tell(link, ` ${formatBytes(recording.bytes)}, ${when} `, ...again);
      link.click();
    } catch (error) {
      tell(`The recording was not written: ${error.message}`);
    } finally {
      sessionStorage.removeItem(WAITED_FOR);
      [button.disabled, button.textContent] = [false, 'Save .rrd'];
    }
  };
  button.addEventListener('click', () => save(wanted()));
  const before = sessionStorage.getItem(WAITED_FOR);
  if (before) save(JSON.parse(before));
  return () => save(wanted());
}

function act(textContent, then, className = 'text') {
  const button = Object.assign(document.createElement('button'), {
    type: 'button',
    className,
    textContent,
  });
  button.addEventListener('click', then);
  return button;
}
