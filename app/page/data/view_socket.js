/** The socket of a view: sends the cursor and receives maps (docs/api.md). At most one cursor is in flight. */

/** @import { MapChoices } from '../maps/map_choices.js' */
/** @import { Maps } from '../maps/map_values.js' */
/** @import { Selection } from '../types/server.js' */

import { MAP_SIZE } from '../core/constants.js';
import { messageOf, openSocket } from '../core/dom.js';
import { readMaps } from '../maps/map_values.js';
import { openView } from './api.js';

/**
 * @typedef {Selection & MapChoices & {step: number, angle: number | null, comparison_maps?: boolean}} Cursor
 * @typedef {Cursor & {size: number, scene: boolean}} Message
 * @typedef {{size?: number, inputTime?: number | null}} Cause of an answer: the cursor's map size and input
 * @typedef {object} Handlers
 * @property {(view: {view: string, scene: string}) => void} view a view was opened
 * @property {(factor: number) => boolean} pace sets the pause of the 3D scene, and returns whether it may render now
 * @property {(maps: Maps, inputTime: number | null) => void} maps
 * @property {(step: number, size: number | undefined, reason: string) => void} noMaps the filter or step has no maps
 * @property {(step: number, inputTime: number | null) => void} drawn the 3D scene shows the step; inputTime: of the last input, with the first scene of its step
 * @property {(line: string) => void} error
 * @property {(problem: string | null) => void} connection
 */

const FINE_DELAY = 120; // ms after the last change of the cursor
const SCRUB_GAP = 250; // ms; an input sooner after the previous one belongs to the same scrub
const RESPONSE_TIMEOUT = 10_000; // ms
/** Pause between renderings of a slow 3D scene, as a multiple of their duration. */
const PACE = { scrubbing: Infinity, playing: 1, idle: 0 };
const RETRY_DELAY = { first: 500, max: 8000 }; // ms

export class ViewSocket {
  #handlers;
  #dark;
  #sceneOptions;
  /** @type {{view: string, scene: string, socket: string} | null} */
  #view = null;
  /** @type {WebSocket | null} */
  #socket = null;
  #serial = 0;
  /** Next message. @type {{cursor: Message, inputTime: number | null} | null} */
  #next = null;
  /** Requests for the maps of other steps, between cursors. @type {{cursor: Message, resolve: (maps: Maps | null) => void, serial: number}[]} */
  #requests = [];
  #newest = 0; // serial of the newest cursor
  /** @type {number | null} */
  #inFlight = null;
  /** @type {Map<number, Cause>} */
  #sent = new Map();
  /** @type {Cursor | null} */
  #last = null;
  /** Time of the last input in ms, and whether the 3D scene has shown its step. */
  #input = { time: -Infinity, drawn: true };
  /** Maps of the comparison run, which arrive first. @type {Maps | null} */
  #comparison = null;
  /** @type {number | undefined} */
  #fineTimer;
  /** @type {number | undefined} */
  #responseTimer;
  #retryDelay = RETRY_DELAY.first;

  /**
   * @param {Handlers} handlers
   * @param {() => boolean} dark
   * @param {() => object} sceneOptions
   */
  constructor(handlers, dark, sceneOptions) {
    this.#handlers = handlers;
    this.#dark = dark;
    this.#sceneOptions = sceneOptions;
    this.#connect();
  }

  /**
   * Moves the cursor: requests coarse maps now, and fine maps when it stops. A slow scene follows the first input of a
   * scrub, such as a single key, and then waits until the cursor stops.
   * @param {Cursor} cursor
   * @param {number | null} [inputTime]
   */
  move(cursor, inputTime = null) {
    this.#last = cursor;
    const scrubbing = inputTime !== null && inputTime - this.#input.time < SCRUB_GAP;
    const pace = scrubbing ? PACE.scrubbing : inputTime === null ? PACE.playing : PACE.idle;
    if (inputTime !== null) this.#input = { time: inputTime, drawn: false };
    const scene = this.#handlers.pace(pace);
    this.#enqueue({ ...cursor, size: MAP_SIZE.coarse, scene }, inputTime);
    clearTimeout(this.#fineTimer);
    this.#fineTimer = setTimeout(
      () => this.#enqueue({ ...cursor, size: MAP_SIZE.fine, scene: true }, null),
      FINE_DELAY,
    );
  }

  /**
   * Requests the maps of another step without moving the cursor.
   * @param {Cursor} cursor
   * @param {number} [size]
   * @returns {Promise<Maps | null>} null if the server has no answer
   */
  requestMaps(cursor, size = MAP_SIZE.fine) {
    return new Promise((resolve) => {
      const message = { ...cursor, against: '', size, scene: false };
      this.#requests.push({ cursor: message, resolve, serial: 0 });
      this.#flush();
    });
  }

  /** @param {boolean} dark */
  setTheme(dark) {
    this.#send({ type: 'theme', dark });
  }

  /**
   * Sets layers and colours of the 3D scene.
   * @param {object} options see scene_menu.js
   */
  setScene(options) {
    this.#send({ type: 'scene_layers', ...options });
  }

  /**
   * Moves the camera of the 3D scene.
   * @param {string} at one of `VIEWPOINTS`
   */
  setViewpoint(at) {
    this.#send({ type: 'viewpoint', at });
  }

  /**
   * @param {Message} cursor
   * @param {number | null} inputTime
   */
  #enqueue(cursor, inputTime) {
    // A fine cursor that replaces the coarse one of its step keeps the time of the input.
    const replaced = this.#next?.cursor.step === cursor.step ? this.#next.inputTime : null;
    this.#next = { cursor, inputTime: inputTime ?? replaced };
    this.#flush();
  }

  #flush() {
    if (this.#inFlight !== null || this.#socket?.readyState !== WebSocket.OPEN) return;
    const [request] = this.#requests;
    if (!this.#next && request && !request.serial) {
      request.serial = ++this.#serial;
      this.#sendCursor(request.cursor);
    } else if (this.#next) {
      const { cursor, inputTime } = this.#next;
      this.#next = null;
      this.#newest = ++this.#serial;
      this.#sent.set(this.#serial, { size: cursor.size, inputTime });
      this.#sendCursor(cursor);
    }
  }

  /** @param {Message} cursor */
  #sendCursor(cursor) {
    const serial = (this.#inFlight = this.#serial);
    this.#send({ type: 'cursor', serial, ...cursor });
    this.#responseTimer = setTimeout(() => this.#answered(serial), RESPONSE_TIMEOUT);
  }

  /** @param {number} serial */
  #answered(serial) {
    if (serial !== this.#inFlight) return;
    clearTimeout(this.#responseTimer);
    this.#inFlight = null;
    this.#flush();
  }

  /** @param {object} message */
  #send(message) {
    if (this.#socket?.readyState === WebSocket.OPEN) this.#socket.send(JSON.stringify(message));
  }

  async #connect() {
    try {
      if (!this.#view) {
        this.#view = await openView(this.#dark());
        this.#handlers.view(this.#view);
      }
    } catch (error) {
      this.#retry(messageOf(error));
      return;
    }
    const socket = openSocket(this.#view.socket);
    let opened = false;
    socket.onopen = () => {
      opened = true;
      this.#retryDelay = RETRY_DELAY.first;
      this.#handlers.connection(null);
      this.setScene(this.#sceneOptions());
      if (this.#last) this.move(this.#last);
    };
    socket.onmessage = ({ data }) =>
      data instanceof ArrayBuffer ? this.#receiveMaps(data) : this.#receive(JSON.parse(data));
    socket.onclose = () => {
      if (this.#socket === socket) this.#disconnected(opened);
    };
    this.#socket = socket;
  }

  /** @param {boolean} opened whether the socket had been open */
  #disconnected(opened) {
    // If the socket cannot even be opened, the server no longer has the view.
    if (!opened) this.#view = null;
    clearTimeout(this.#responseTimer);
    this.#inFlight = null;
    if (this.#requests.length) this.#requests[0].serial = 0;
    this.#sent.clear();
    this.#handlers.pace(PACE.idle);
    this.#retry('The connection to the server is lost.');
  }

  /** @param {string} problem */
  #retry(problem) {
    const seconds = Math.max(1, Math.round(this.#retryDelay / 1000));
    this.#handlers.connection(`${problem} Retrying every ${seconds} s …`);
    setTimeout(() => this.#connect(), this.#retryDelay);
    this.#retryDelay = Math.min(2 * this.#retryDelay, RETRY_DELAY.max);
  }

  /** @param {ArrayBuffer} data */
  #receiveMaps(data) {
    const maps = readMaps(data);
    if (maps.serial === this.#requests[0]?.serial) {
      this.#requests.shift()?.resolve(maps);
    } else if (maps.other) {
      this.#comparison = maps;
      return;
    } else {
      maps.beside = this.#comparison?.serial === maps.serial ? this.#comparison : null;
      this.#handlers.maps(maps, this.#sent.get(maps.serial)?.inputTime ?? null);
    }
    this.#answered(maps.serial);
  }

  /** @param {{type: string, serial: number, step: number, reason: string, error: string}} message */
  #receive({ type, serial, step, reason, error }) {
    const cause = this.#sent.get(serial) ?? {};
    if (type !== 'drawn' && serial === this.#requests[0]?.serial)
      this.#requests.shift()?.resolve(null);
    if (type === 'no_maps') {
      this.#handlers.noMaps(step, cause.size, reason);
      this.#answered(serial);
    }
    if (type === 'drawn') {
      if (cause.size === MAP_SIZE.fine && serial === this.#newest) this.#handlers.pace(PACE.idle);
      const first = step === this.#last?.step && !this.#input.drawn;
      if (first) this.#input.drawn = true;
      this.#handlers.drawn(step, first ? this.#input.time : null);
      for (const key of this.#sent.keys()) if (key <= serial) this.#sent.delete(key);
    }
    if (type === 'error') {
      this.#handlers.error(error);
      this.#sent.delete(serial);
      this.#answered(serial);
    }
  }
}
