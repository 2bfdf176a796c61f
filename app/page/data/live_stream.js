/** The steps of a live run as they come (docs/api.md): asked for one block at a time, so that none ever waits here. */

import { Trace } from './trace.js';

const AGAIN = 1000; // ms until a socket that has gone is opened anew
const REFUSED = 4000; // code with which the server closes it where there is no such run

/**
 * @typedef {object} Block of steps @property {number} first @property {number} steps @property {number} of how many there are by now
 * @property {{name: string, shape: number[], offset: number}[]} columns @property {ArrayBuffer} buffer that they lie in
 * @property {ArrayBuffer | null} pictures @property {number} written s since 1970 @property {string} state @property {string} told
 */

export class Stream {
  /** Why there are no steps to be had; empty while there may be. */
  refused = '';
  #url;
  #socket = null;
  #closed = false;
  #waiting = null;

  /** @param {string} name of the run */
  constructor(name) {
    this.#url = new URL(`/api/live/${encodeURIComponent(name)}`, location.href);
    this.#url.protocol = this.#url.protocol.replace('http', 'ws');
  }

  /**
   * The next steps as soon as there are any, or an empty block where none come for a while; null once it is closed.
   * @param {number} first that is wanted @param {string} state of the run, as it is known here @returns {Promise<Block | null>}
   */
  async next(first, state) {
    while (!this.#closed) {
      try {
        await this.#open();
        return await new Promise((...settle) => {
          this.#waiting = settle;
          this.#socket.send(JSON.stringify({ from: first, state }));
        });
      } catch {
        if (!this.#closed) await new Promise((resolve) => setTimeout(resolve, AGAIN));
      }
    }
    return null;
  }

  close() {
    this.#closed = true;
    this.#socket?.close();
  }

  async #open() {
    if (this.#socket?.readyState === WebSocket.OPEN) return;
    const socket = (this.#socket = new WebSocket(this.#url));
    socket.binaryType = 'arraybuffer';
    socket.onmessage = ({ data }) => this.#waiting?.[0](block(data));
    await new Promise((resolve, reject) => {
      socket.onopen = resolve;
      socket.onclose = ({ code, reason }) => {
        if (code === REFUSED) [this.#closed, this.refused] = [true, reason];
        reject();
        this.#waiting?.[1]();
      };
    });
  }
}

/** @param {ArrayBuffer} message @returns {Block} */
function block(message) {
  const length = new DataView(message).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(message, 4, length)));
  const start = 4 + Math.ceil(length / 4) * 4;
  const end = message.byteLength - header.pictures;
  return { ...header, buffer: message.slice(start, end), pictures: header.pictures ? message.slice(end) : null };
}

/**
 * The trace of a live run with the first of its steps; `trace.stream` has those that follow.
 * @param {import('./api.js').Task} task @param {import('./api.js').Selection} selection
 * @param {object} header as the server sent it @param {AbortSignal} signal @returns {Promise<Trace>}
 */
export async function begun(task, selection, header, signal) {
  const stream = new Stream(header.live.name);
  signal.addEventListener('abort', () => stream.close());
  let found = await stream.next(0, header.live.state);
  while (found && !found.steps) found = await stream.next(0, found.state);
  signal.throwIfAborted();
  const trace = new Trace(task, selection, { ...header, steps: found.steps, columns: found.columns }, found.buffer, found.pictures);
  return Object.assign(trace, { stream, live: { ...header.live, ...told(found) } });
}

/** What a block says of its run. @param {Block} found */
export const told = ({ state, told: line, of }) => ({ state, told: line, steps: of });
