/** The view's socket: sends the cursor, receives maps (docs/api.md). Never more than one cursor in flight. */

import { openView } from './api.js';
import { readMaps } from '../maps/map_values.js';

/**
 * @typedef {import('./api.js').Selection & {step: number, angle: number | null, size: number}} Cursor
 * @typedef {import('../maps/map_values.js').Maps} Maps
 * @typedef {object} Handlers
 * @property {(view: {view: string, scene: string}) => void} view a new view has been opened
 * @property {(times: number) => boolean} pace of the scene: see frame.js
 * @property {(maps: Maps, inputTime: number | null) => void} maps @property {(step: number, cause: object) => void} drawn
 * @property {(step: number, size: number) => void} noMaps of a filter that has none @property {(step: number) => void} moved in the 3D scene
 * @property {(line: string) => void} error @property {(problem: string | null) => void} connection
 */

const COARSE = 41;
const FINE = 135;
const REST = 120; // ms without a move after which the fine maps are asked for
const PATIENCE = 10_000; // ms until an answer is taken for lost
/** Where the scene is drawn slowly, it waits so many times as long as it takes: for a hand until it rests. */
const PAUSE = { hand: Infinity, clock: 3, rest: 0 };
const RETRY = { first: 500, most: 8000 }; // ms

export class ViewSocket {
  #handlers;
  #dark;
  #look;
  #view = null;
  #socket = null;
  #serial = 0;
  #wanted = null;
  #asked = null; // {cursor, done, serial}: maps of another moment, between two cursors
  #newest = 0; // serial of the newest cursor
  #inFlight = null;
  #sent = new Map();
  #last = null;
  #beside = null; // the other run's maps, which come before this one's
  #rest = 0;
  #lost = 0;
  #pause = RETRY.first;

  /** @param {Handlers} handlers @param {() => boolean} dark @param {() => object} look of the scene */
  constructor(handlers, dark, look) {
    [this.#handlers, this.#dark, this.#look] = [handlers, dark, look];
    this.#connect();
  }

  /** The cursor has moved: coarse maps now; fine ones and the scene when it rests. @param {Cursor} cursor without its size. */
  move(cursor, inputTime = null) {
    this.#last = cursor;
    const scene = this.#handlers.pace(inputTime === null ? PAUSE.clock : PAUSE.hand);
    this.#want({ ...cursor, size: COARSE, scene }, inputTime);
    clearTimeout(this.#rest);
    this.#rest = setTimeout(() => this.#want({ ...cursor, size: FINE, scene: true }, null), REST);
  }

  /** The fine maps of another moment; the cursor stays where it is. @param {object} cursor without its size. @returns {Promise<Maps>} */
  ask(cursor) {
    return new Promise((done) => {
      this.#asked = { cursor: { against: '', ...cursor, size: FINE, scene: false }, done, serial: 0 };
      this.#pump();
    });
  }

  /** The page's colours have changed. */
  theme(dark) {
    this.#send({ type: 'theme', dark });
  }

  /** The scene is to be looked at in another way. @param {object} look see scenelook.js */
  look(look) {
    this.#send({ type: 'look', ...look });
  }

  /** The eye in the scene is to move. @param {'first' | 'above' | 'camera'} at */
  stand(at) {
    this.#send({ type: 'stand', at });
  }

  #want(cursor, inputTime) {
    // A coarse cursor that was overtaken by its own fine one must not lose when its input came.
    const before = this.#wanted;
    this.#wanted = { cursor, inputTime: inputTime ?? (before?.cursor.step === cursor.step ? before.inputTime : null) };
    this.#pump();
  }

  #pump() {
    if (this.#inFlight !== null || this.#socket?.readyState !== WebSocket.OPEN) return;
    const asked = this.#asked && !this.#asked.serial;
    if (!asked && !this.#wanted) return;
    const { cursor, inputTime } = asked ? this.#asked : this.#wanted;
    this.#inFlight = ++this.#serial;
    if (asked) this.#asked.serial = this.#serial;
    else {
      this.#wanted = null;
      this.#newest = this.#serial;
      this.#sent.set(this.#serial, { ...cursor, inputTime });
    }
    this.#send({ type: 'cursor', serial: this.#serial, ...cursor });
    this.#lost = setTimeout(() => this.#answered(this.#inFlight), PATIENCE);
  }

  #answered(serial) {
    if (serial !== this.#inFlight) return;
    clearTimeout(this.#lost);
    this.#inFlight = null;
    this.#pump();
  }

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
      this.#retry(error.message);
      return;
    }
    const url = new URL(this.#view.socket, location.href);
    url.protocol = url.protocol.replace('http', 'ws');
    const socket = new WebSocket(url);
    socket.binaryType = 'arraybuffer';
    let opened = false;
    socket.onopen = () => {
      opened = true;
      this.#pause = RETRY.first;
      this.#handlers.connection(null);
      this.look(this.#look());
      if (this.#last) this.move(this.#last);
    };
    socket.onmessage = (event) => this.#heard(event.data);
    socket.onclose = () => {
      if (this.#socket !== socket) return;
      // A view whose socket does not even open has gone with its server.
      if (!opened) this.#view = null;
      clearTimeout(this.#lost);
      this.#inFlight = null;
      if (this.#asked) this.#asked.serial = 0;
      this.#sent.clear();
      this.#handlers.pace(PAUSE.rest);
      this.#retry('The server has gone.');
    };
    this.#socket = socket;
  }

  #retry(problem) {
    const seconds = this.#pause / 1000;
    this.#handlers.connection(`${problem} Trying again every ${seconds < 1 ? 'moment' : `${Math.round(seconds)} s`} …`);
    setTimeout(() => this.#connect(), this.#pause);
    this.#pause = Math.min(2 * this.#pause, RETRY.most);
  }

  #heard(data) {
    if (data instanceof ArrayBuffer) {
      const maps = readMaps(data);
      if (maps.serial === this.#asked?.serial) {
        this.#asked.done(maps);
        this.#asked = null;
        this.#answered(maps.serial);
        return;
      }
      if (maps.other) {
        this.#beside = maps;
        return;
      }
      maps.beside = this.#beside?.serial === maps.serial ? this.#beside : null;
      const sent = this.#sent.get(maps.serial);
      this.#handlers.maps(maps, sent?.inputTime ?? null);
      this.#answered(maps.serial);
      return;
    }
    const message = JSON.parse(data);
    if (message.type === 'cursor') this.#handlers.moved(message.step);
    if (message.type === 'no_maps') {
      this.#handlers.noMaps(message.step, this.#sent.get(message.serial)?.size);
      this.#answered(message.serial);
    }
    if (message.type === 'drawn') {
      const sent = this.#sent.get(message.serial) ?? {};
      if (sent.size === FINE && message.serial === this.#newest) this.#handlers.pace(PAUSE.rest);
      this.#handlers.drawn(message.step, sent);
      for (const serial of this.#sent.keys()) if (serial <= message.serial) this.#sent.delete(serial);
    }
    if (message.type === 'error') {
      this.#handlers.error(message.error);
      this.#sent.delete(message.serial);
      this.#answered(message.serial);
    }
  }
}
