/** Background jobs: their state, progress and log. Jobs continue when the page is closed. */

/** @import { Job } from '../types/server.js' */

import { element, html } from '../core/dom.js';
import { percent, sentence } from '../core/units.js';
import * as api from '../data/api.js';

const POLL_INTERVAL = 500; // ms, while a job is active
const IDLE_INTERVAL = 3000; // ms, otherwise: other pages and other users of the server start jobs too

/**
 * Returns whether a job is waiting or running.
 * @param {Job | null | undefined} job
 */
export const isActive = (job) => job?.state === 'waiting' || job?.state === 'running';

export class Jobs {
  #drawer;
  #button;
  /** @type {Job[]} */
  #list = [];
  /** @type {Set<(jobs: Job[]) => void>} */
  #listeners = new Set();
  /** @type {Map<string, HTMLLIElement>} */
  #rows = new Map();
  #timer = 0;

  /**
   * @param {HTMLElement} drawer
   * @param {HTMLButtonElement} button opens the drawer
   */
  constructor(drawer, button) {
    this.#drawer = drawer;
    this.#button = button;
    button.addEventListener('click', () => this.toggle());
    this.#closeButton.addEventListener('click', () => this.toggle());
    drawer.addEventListener('keydown', (event) => event.key === 'Escape' && this.toggleByKey());
    document.addEventListener('visibilitychange', () => document.hidden || this.refresh());
    this.refresh();
  }

  get #closeButton() {
    return element('.bar button', HTMLButtonElement, this.#drawer);
  }

  /** @param {(jobs: Job[]) => void} listener called when a job has changed, and at once if there are jobs */
  listen(listener) {
    this.#listeners.add(listener);
    if (this.#list.length) queueMicrotask(() => listener(this.#list));
  }

  /**
   * Returns the last known state of a job.
   * @param {string | null | undefined} id
   */
  find(id) {
    return this.#list.find((job) => job.id === id);
  }

  /**
   * Waits until a job has ended; returns undefined if it was removed.
   * @param {string} id
   * @param {(job: Job) => void} progress called at each change before
   * @returns {Promise<Job | undefined>}
   */
  async ended(id, progress) {
    await this.refresh();
    return new Promise((resolve) => {
      const listener = () => {
        const job = this.find(id);
        if (job && isActive(job)) return progress(job);
        this.#listeners.delete(listener);
        resolve(job);
      };
      this.#listeners.add(listener);
      listener();
    });
  }

  /** Opens or closes the drawer. */
  toggle() {
    const opens = this.#drawer.hidden;
    const { activeElement } = document;
    this.#drawer.hidden = !opens;
    this.#button.setAttribute('aria-expanded', String(opens));
    if (opens) this.#closeButton.focus();
    else if (this.#drawer.contains(activeElement) || activeElement === document.body)
      this.#button.focus();
    this.refresh();
  }

  /** Opens or closes the drawer by a shortcut; afterwards the page has its keys again, such as Space to play. */
  toggleByKey() {
    this.toggle();
    if (this.#drawer.hidden) this.#button.blur();
  }

  /** Gets the jobs from the server, and again at intervals: short ones while a job is active. */
  async refresh() {
    clearTimeout(this.#timer);
    const list = await api.jobs().catch(() => null);
    if (list) this.#update(list);
    clearTimeout(this.#timer);
    const isBusy = this.#list.some(isActive);
    if (document.hidden && !isBusy) return; // until it is visible
    this.#timer = setTimeout(() => this.refresh(), isBusy ? POLL_INTERVAL : IDLE_INTERVAL);
  }

  /**
   * Cancels an active job, or removes one that is displayed as ended: a job may end just before it is cancelled.
   * @param {string} id
   */
  async cancel(id) {
    const job = this.find(id);
    await api.cancelJob(id, !job || isActive(job)).catch(() => {}); // already removed
    await this.refresh();
  }

  /** @param {Job[]} list */
  #update(list) {
    const changed = JSON.stringify(list) !== JSON.stringify(this.#list);
    this.#list = list;
    const active = list.filter(isActive).length;
    this.#button.dataset.active = active ? String(active) : '';
    if (!this.#drawer.hidden) this.#show();
    if (changed) for (const listener of this.#listeners) listener(list);
  }

  #show() {
    const host = html('ol', this.#drawer);
    for (const [id, row] of this.#rows) {
      if (this.#list.some((job) => job.id === id)) continue;
      if (row.contains(document.activeElement)) this.#closeButton.focus();
      row.remove();
      this.#rows.delete(id);
    }
    this.#list.forEach((job, i) => {
      const row = this.#rows.get(job.id) ?? this.#row(job.id);
      this.#rows.set(job.id, row);
      if (host.children[i] !== row) host.insertBefore(row, host.children[i] ?? null);
      this.#fill(row, job);
    });
    html('.none', this.#drawer).hidden = this.#list.length > 0;
  }

  /** @param {string} id */
  #row(id) {
    const row = document.createElement('li');
    row.innerHTML =
      '<h3></h3><button type="button" class="text quiet"></button><progress max="1"></progress><p class="state"></p>' +
      '<details><summary>Log</summary><pre tabindex="0"></pre></details>';
    html('button', row).addEventListener('click', () => this.cancel(id));
    html('details', row).addEventListener('toggle', () => this.#showLog(row, id));
    return row;
  }

  /**
   * @param {HTMLLIElement} row
   * @param {Job} job
   */
  #fill(row, job) {
    row.dataset.state = job.state;
    const title = html('h3', row);
    if (job.link && job.state === 'done') {
      const link = title.querySelector('a') ?? document.createElement('a');
      [link.href, link.textContent] = [`/${job.link}`, job.title];
      if (!link.isConnected) title.replaceChildren(link);
    } else title.textContent = job.title;
    const button = html('button', row);
    button.textContent = isActive(job) ? 'Cancel' : 'Remove';
    button.setAttribute('aria-label', `${button.textContent}: ${job.title}`);
    const progress = element('progress', HTMLProgressElement, row);
    progress.value = job.state === 'done' ? 1 : job.progress;
    progress.setAttribute('aria-label', `Progress of ${job.title}`);
    html('.state', row).textContent = jobSummary(job);
    if (isActive(job)) this.#showLog(row, job.id);
  }

  /**
   * @param {HTMLLIElement} row
   * @param {string} id
   */
  async #showLog(row, id) {
    if (!element('details', HTMLDetailsElement, row).open) return;
    const { log } = await api.job(id).catch(() => ({ log: '' }));
    html('pre', row).textContent = log || 'The log is empty.';
  }
}

/**
 * Returns the state of a job in one line.
 * @param {Job} job
 */
export function jobSummary(job) {
  if (job.state === 'running')
    return [percent(job.progress), job.message || 'starting', timeLeft(job.remaining)]
      .filter(Boolean)
      .join(', ');
  if (job.error && job.error !== job.state)
    return sentence(job.state === 'failed' ? job.error : `${job.state}: ${job.error}`);
  if (job.state === 'done') {
    const seconds = Number(job.ended) - Number(job.started);
    return `Done in ${Math.max(1, Math.round(seconds))} s.`;
  }
  if (job.state === 'cancelled' && job.kind === 'finetune') return 'Paused.'; // it resumes
  return sentence(job.state);
}

/**
 * Writes the estimated time to the end of a running job; empty if it is unknown.
 * @param {number | null} seconds
 */
export function timeLeft(seconds) {
  if (seconds === null) return '';
  return seconds < 90 ? `${Math.ceil(seconds)} s left` : `${Math.round(seconds / 60)} min left`;
}
