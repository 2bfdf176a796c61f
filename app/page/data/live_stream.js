/** The steps of a live run, received block by block on request (docs/api.md). */

/** @import { LiveRun, Selection, Task, TraceHeader } from '../types/server.js' */
/** @import { Column } from '../types/server.js' */

import { openSocket, pause } from '../core/dom.js';
import { decodeHeader } from './arrays.js';
import { ServerError } from './server_error.js';
import { Trace } from './trace.js';

const RECONNECT_DELAY = 1000; // ms
const NOT_FOUND = 4000; // close code if the run does not exist

/**
 * @typedef {object} Block of steps
 * @property {number} first
 * @property {number} steps
 * @property {number} total steps of the run so far
 * @property {Column[]} columns
 * @property {ArrayBuffer} buffer of the columns
 * @property {ArrayBuffer | null} images
 * @property {number} written time in s since 1970
 * @property {string} state of the run
 * @property {string} message about the state
 */

export class LiveStream {
  /** Why the run cannot be read; empty if it can. */
  error = '';
  #path;
  /** @type {WebSocket | null} */
  #socket = null;
  #closed = false;
  /** @type {{resolve: (block: Block) => void, reject: (reason?: unknown) => void} | null} */
  #pending = null;

  /** @param {string} name of the run */
  constructor(name) {
    this.#path = `/api/live/${encodeURIComponent(name)}`;
  }

  /**
   * Returns the next steps once they exist, or an empty block after a timeout; null after `close`.
   * @param {number} first
   * @param {string} state last known state of the run
   * @returns {Promise<Block | null>}
   */
  async next(first, state) {
    while (!this.#closed) {
      try {
        const socket = await this.#open();
        return await new Promise((resolve, reject) => {
          this.#pending = { resolve, reject };
          socket.send(JSON.stringify({ from: first, state }));
        });
      } catch {
        if (!this.#closed) await pause(RECONNECT_DELAY);
      }
    }
    return null;
  }

  close() {
    this.#closed = true;
    this.#socket?.close();
  }

  /** @returns {Promise<WebSocket>} */
  async #open() {
    if (this.#socket?.readyState === WebSocket.OPEN) return this.#socket;
    const socket = (this.#socket = openSocket(this.#path));
    socket.onmessage = ({ data }) => this.#pending?.resolve(decodeBlock(data));
    await new Promise((resolve, reject) => {
      socket.onopen = resolve;
      socket.onclose = ({ code, reason }) => {
        if (code === NOT_FOUND) [this.#closed, this.error] = [true, reason];
        reject();
        this.#pending?.reject();
      };
    });
    return socket;
  }
}

/**
 * @param {ArrayBuffer} message
 * @returns {Block}
 */
export function decodeBlock(message) {
  const { header, end: start } = decodeHeader(message);
  const { image_bytes: imageBytes, ...block } = header;
  const end = message.byteLength - imageBytes;
  return {
    ...block,
    buffer: message.slice(start, end),
    images: imageBytes ? message.slice(end) : null,
  };
}

/**
 * Loads the first steps of a live run; `trace.stream` provides the following ones.
 * @param {Task} task
 * @param {Selection} selection
 * @param {TraceHeader} header
 * @param {LiveRun} run
 * @param {AbortSignal} signal
 * @returns {Promise<Trace>}
 */
export async function loadLiveTrace(task, selection, header, run, signal) {
  const stream = new LiveStream(run.name);
  signal.addEventListener('abort', () => stream.close());
  let block = await stream.next(0, run.state);
  while (block && !block.steps) block = await stream.next(0, block.state);
  signal.throwIfAborted();
  if (!block) throw new ServerError(`The live run cannot be read: ${stream.error}.`);
  const { steps, columns, buffer, images } = block;
  const trace = new Trace(task, selection, { ...header, steps, columns }, buffer, images);
  return Object.assign(trace, { stream, live: { ...run, ...liveStatus(block) } });
}

/**
 * Returns the state of a run as of a block.
 * @param {Block} block
 */
export const liveStatus = ({ state, message, total }) => ({ state, message, steps: total });
