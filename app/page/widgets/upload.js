/** Uploads of recordings, one after the other, each with progress, cancellation and its error. */

/** @import { RecordingEntry } from '../types/server.js' */

import { create, createButton, messageOf } from '../core/dom.js';
import { formatBytes, percent } from '../core/units.js';
import { ServerError } from '../data/server_error.js';

export class Uploads {
  #host;
  #done;
  #last = Promise.resolve();
  /** Names of uploads that have not ended. @type {Set<string>} */
  #pending = new Set();

  /**
   * @param {HTMLElement} host a list
   * @param {(recording: RecordingEntry) => void} done called for each uploaded recording
   */
  constructor(host, done) {
    this.#host = host;
    this.#done = done;
  }

  /**
   * @param {File[]} files
   * @param {Set<string>} names names in use
   * @param {number} limit bytes
   */
  add(files, names, limit) {
    for (const file of files) {
      const name = unusedName(file.name, new Set([...names, ...this.#pending]));
      this.#pending.add(name);
      this.#last = this.#upload(file, name, limit, this.#last).finally(() =>
        this.#pending.delete(name),
      );
    }
  }

  /**
   * @param {File} file
   * @param {string} name of the recording
   * @param {number} limit
   * @param {Promise<void>} previous upload
   */
  async #upload(file, name, limit, previous) {
    const text = create('span', {
      textContent: `${file.name}, ${formatBytes(file.size)}: waiting`,
    });
    const bar = create('progress', { max: 1, value: 0, ariaLabel: `Progress of ${file.name}` });
    const request = new XMLHttpRequest();
    let cancelled = false;
    const button = createButton('text quiet', 'Cancel', () => {
      cancelled = true;
      request.abort();
      line.remove();
    });
    const line = create('li', {}, text, bar, button);
    this.#host.append(line);
    await previous;
    if (cancelled) return;
    try {
      if (file.size > limit) {
        const [size, maximum] = [formatBytes(file.size), formatBytes(limit)];
        throw new ServerError(`it has ${size}; the limit is ${maximum}`);
      }
      const recording = await send(request, file, name, (share) => {
        bar.value = share;
        text.textContent = `${file.name}: ${share < 1 ? percent(share) : 'checking'}`;
      });
      line.remove();
      this.#done(recording);
    } catch (error) {
      line.dataset.state = 'error';
      text.textContent = `${file.name} was not added: ${messageOf(error)}`;
      bar.remove();
      [button.textContent, button.ariaLabel] = ['×', 'Dismiss'];
    }
  }
}

/**
 * Returns the name of a recording, with a number if it is in use.
 * @param {string} name
 * @param {Set<string>} names names in use
 */
export function unusedName(name, names) {
  const stem = name.normalize('NFC').replace(/\.rrd$/i, ''); // the server stores normal form C
  let candidate = `${stem}.rrd`;
  for (let n = 2; names.has(candidate); n++) candidate = `${stem}-${n}.rrd`;
  return candidate;
}

/**
 * Uploads a file. An XMLHttpRequest, because fetch reports no upload progress.
 * @param {XMLHttpRequest} request
 * @param {File} file
 * @param {string} name
 * @param {(share: number) => void} progress
 * @returns {Promise<RecordingEntry>}
 */
function send(request, file, name, progress) {
  return new Promise((resolve, reject) => {
    request.open('PUT', `/api/recordings/${encodeURIComponent(name)}`);
    request.responseType = 'json';
    request.upload.addEventListener('progress', ({ loaded, total }) =>
      progress(total ? loaded / total : 1),
    );
    request.addEventListener('load', () => {
      if (request.status === 201) resolve(request.response);
      else
        reject(
          new ServerError(request.response?.error ?? `the server responded ${request.status}`),
        );
    });
    request.addEventListener('error', () => reject(new ServerError('the server does not respond')));
    request.addEventListener('abort', () => reject(new ServerError('it was cancelled'))); // the next upload waits for this one
    request.send(file);
  });
}
