/** Results that background jobs compute: loaded, started, followed and kept by key; and their button. */

/** @import { Job, JobReply } from '../types/server.js' */
/** @import { Jobs } from './jobs.js' */

import { create, createButton, html, messageOf } from '../core/dom.js';
import { sentence } from '../core/units.js';
import * as api from '../data/api.js';
import { isActive, jobSummary } from './jobs.js';

/**
 * A result, or why there is none yet. absent: not requested; active: its job waits or runs; ended: without a result.
 * preliminary: the server's estimate of the result until then. isRefusal: trying again cannot help.
 * @template T
 * @typedef {({state: 'ready', result: T, job?: undefined}
 *   | {state: 'absent' | 'loading', job?: undefined}
 *   | {state: 'active' | 'ended', job: Job}
 *   | {state: 'error', error: string, isRefusal?: boolean, job?: undefined}) & {preliminary?: T}} JobResult
 */

/**
 * @template {object} T
 */
export class JobResults {
  #jobs;
  #capacity;
  #changed;
  /** @type {Map<string, JobResult<T>>} least recently changed first */
  #results = new Map();
  /** Arguments of the last load. @type {Parameters<JobResults<T>['load']> | null} */
  #loaded = null;
  /** Ids of all jobs; null before the first list. @type {Set<string> | null} */
  #ids = null;

  /**
   * @param {Jobs} jobs
   * @param {number} capacity number of results that are kept
   * @param {(finished: string[]) => void} changed called after a change, with the keys of finished jobs: load them again
   */
  constructor(jobs, capacity, changed) {
    this.#jobs = jobs;
    this.#capacity = capacity;
    this.#changed = changed;
    jobs.listen((list) => this.#follow(list));
  }

  /**
   * @param {string} key
   * @returns {JobResult<T>}
   */
  get(key) {
    return this.#results.get(key) ?? { state: 'loading' };
  }

  /** @param {string} key */
  delete(key) {
    this.#results.delete(key);
  }

  /** Forgets all results; their jobs continue. */
  clear() {
    this.#results.clear();
  }

  /**
   * Loads a result, unless it is known, or the state of its job.
   * @param {string} key
   * @param {string} url
   * @param {AbortSignal} signal of the request
   */
  async load(key, url, signal) {
    this.#loaded = [key, url, signal];
    if (!this.#results.has(key)) this.#set(key, { state: 'loading' });
    this.#changed([]);
    if (this.get(key).state === 'ready') return;
    try {
      /** @type {T | JobReply<T>} */
      const reply = await api.poll(url, signal);
      if ('job' in reply) this.#wait(key, jobState(reply.job), reply.preliminary);
      else this.#set(key, { state: 'ready', result: reply });
    } catch (error) {
      if (signal.aborted) return;
      this.#wait(key, failure(error));
    }
    this.#changed([]);
  }

  /**
   * Starts the job of a result, or cancels it if it is active.
   * @param {string} key
   * @param {string} url
   */
  async startOrCancel(key, url) {
    const { job } = this.get(key);
    if (job && isActive(job)) return this.#jobs.cancel(job.id);
    try {
      this.#wait(key, jobState((await api.startJob(url)).job));
    } catch (error) {
      this.#wait(key, failure(error));
    }
    this.#changed([]);
    this.#jobs.refresh();
  }

  /** @param {Job[]} list */
  #follow(list) {
    const finished = [];
    for (const [key, { job }] of [...this.#results]) {
      if (!job) continue;
      const update = list.find(({ id }) => id === job.id) ?? null;
      if (update?.state === 'done') {
        this.#wait(key, { state: 'loading' });
        finished.push(key);
      } else this.#wait(key, jobState(update));
    }
    this.#changed(finished);
    this.#findStarted(list);
  }

  /**
   * Loads the state of the displayed result if its job may have been started by another page.
   * @param {Job[]} list
   */
  #findStarted(list) {
    const known = this.#ids;
    this.#ids = new Set(list.map(({ id }) => id));
    if (!known || !this.#loaded || list.every(({ id }) => known.has(id))) return;
    const [key, , signal] = this.#loaded;
    if (this.get(key).state === 'absent' && !signal.aborted) this.load(...this.#loaded);
  }

  /**
   * @param {string} key
   * @param {JobResult<T>} result that is not ready
   * @param {T} [preliminary]
   */
  #wait(key, result, preliminary = this.get(key).preliminary) {
    this.#set(key, preliminary ? { ...result, preliminary } : result);
  }

  /**
   * @param {string} key
   * @param {JobResult<T>} result
   */
  #set(key, result) {
    this.#results.delete(key);
    this.#results.set(key, result);
    const [oldest] = this.#results.keys();
    if (this.#results.size > this.#capacity) this.#results.delete(oldest);
  }
}

/** @type {Record<string, string>} */
const ACTIONS = { ended: 'Try again', error: 'Try again', active: 'Cancel' };

/**
 * Returns the text of the button of a result; empty for no button.
 * @param {string} state
 * @param {string} start text while the result is not requested
 */
export const jobAction = (state, start) => (state === 'absent' ? start : (ACTIONS[state] ?? ''));

/**
 * Describes a result that is not ready.
 * @param {{state: string, error?: string, job?: Job}} result
 * @param {Record<string, string>} [texts] by state, for results without an error and without a job
 */
export function resultText({ state, error, job }, texts) {
  if (error !== undefined) return sentence(error);
  if (job) return jobSummary(job);
  return { loading: 'Loading …', ...texts }[state] ?? '';
}

/**
 * Returns the state of a result whose request failed.
 * @param {unknown} error
 * @returns {{state: 'error', error: string, isRefusal: boolean, job?: undefined}}
 */
function failure(error) {
  const isRefusal = error instanceof api.ServerError && error.isRefusal;
  return { state: 'error', error: messageOf(error), isRefusal };
}

/**
 * Returns the state of a result whose job is not done; null if there is no job.
 * @param {Job | null} job
 * @returns {{state: 'absent', job?: undefined} | {state: 'active' | 'ended', job: Job}}
 */
function jobState(job) {
  if (!job) return { state: 'absent' };
  return { state: isActive(job) ? 'active' : 'ended', job };
}

/**
 * Shows the button that starts or cancels a job, and the progress of an active one; no button for a refused request.
 * @param {HTMLElement} host
 * @param {{state: string, job?: Job, isRefusal?: boolean}} result
 * @param {object} button
 * @param {string} button.action text; empty: no button
 * @param {string} [button.label] accessible name, if it is not the text
 * @param {string} button.progress accessible name of the progress
 * @param {() => void} button.press
 * @param {HTMLElement} [button.next] gets the focus when the button disappears
 */
export function showJobButton(host, { state, job, isRefusal }, button) {
  const { label, progress, press, next } = button;
  const action = isRefusal ? '' : button.action;
  const key = `${state} ${action && (label || action)}`;
  if (host.dataset.key !== key) {
    const hadFocus = host.contains(document.activeElement);
    host.dataset.key = key;
    host.replaceChildren();
    if (state === 'active') host.append(create('progress', { ariaLabel: progress }));
    if (action) {
      const start = createButton('text', action, press);
      if (label) start.ariaLabel = label;
      host.append(start);
    }
    if (hadFocus) (action ? html('button', host) : next)?.focus();
  }
  const bar = host.querySelector('progress');
  if (bar) bar.value = job?.progress ?? 0;
}
