/** Long work in the background: what runs, how far it is, what it says. It goes on when the page is closed. */

import * as api from '../data/api.js';
import { percent, sentence } from '../core/units.js';

const AGAIN = 500; // ms until the server is asked again, while something is under way
const STATES = {
  waiting: 'waits',
  running: 'runs',
  done: 'done',
  failed: 'failed',
  cancelled: 'cancelled',
  interrupted: 'interrupted',
};

/** @param {api.Job} job */
export const underWay = (job) => job.state === 'waiting' || job.state === 'running';

export class Jobs {
  #drawer;
  #button;
  #list = [];
  #listeners = new Set();
  #rows = new Map();
  #timer = 0;

  /** @param {HTMLElement} drawer @param {HTMLButtonElement} button that opens it */
  constructor(drawer, button) {
    [this.#drawer, this.#button] = [drawer, button];
    button.addEventListener('click', () => this.toggle());
    drawer.querySelector('.bar button').addEventListener('click', () => this.toggle());
    drawer.addEventListener('keydown', (event) => event.key === 'Escape' && this.toggle());
    this.refresh();
  }

  /** @param {(jobs: api.Job[]) => void} listener called when any of them has changed. */
  listen(listener) {
    this.#listeners.add(listener);
  }

  /** One as it was last heard of. @returns {api.Job | undefined} */
  find(id) {
    return this.#list.find((job) => job.id === id);
  }

  /** Waits until one has ended. @param {(job: api.Job) => void} told of every change before @returns {Promise<api.Job | undefined>} undefined: forgotten */
  async ended(id, told) {
    await this.refresh();
    return new Promise((resolve) => {
      const hear = () => {
        const job = this.find(id);
        if (job && underWay(job)) return told(job);
        this.#listeners.delete(hear);
        resolve(job);
      };
      this.#listeners.add(hear);
      hear();
    });
  }

  /** Opens or closes the drawer. */
  toggle() {
    const opens = this.#drawer.hidden;
    this.#drawer.hidden = !opens;
    this.#button.setAttribute('aria-expanded', String(opens));
    if (opens) this.#drawer.querySelector('.bar button').focus();
    else if (
      this.#drawer.contains(document.activeElement) ||
      document.activeElement === document.body
    )
      this.#button.focus();
    this.refresh();
  }

  /** Asks how far they are, and again for as long as something is under way. */
  async refresh() {
    clearTimeout(this.#timer);
    const list = await api.jobs().catch(() => null);
    if (list) this.#take(list);
    clearTimeout(this.#timer);
    if (this.#list.some(underWay)) this.#timer = setTimeout(() => this.refresh(), AGAIN);
  }

  /** Cancels one that is under way, forgets one that has ended. */
  async cancel(id) {
    await api.cancelJob(id).catch(() => {}); // one that is gone already
    await this.refresh();
  }

  #take(list) {
    const changed = JSON.stringify(list) !== JSON.stringify(this.#list);
    this.#list = list;
    const active = list.filter(underWay).length;
    this.#button.textContent = active ? `Jobs (${active})` : 'Jobs';
    if (!this.#drawer.hidden) this.#show();
    if (changed) for (const listener of this.#listeners) listener(list);
  }

  #show() {
    const host = this.#drawer.querySelector('ol');
    for (const [id, row] of this.#rows) {
      if (this.#list.some((job) => job.id === id)) continue;
      if (row.contains(document.activeElement)) this.#drawer.querySelector('.bar button').focus();
      row.remove();
      this.#rows.delete(id);
    }
    this.#list.forEach((job, i) => {
      if (!this.#rows.has(job.id)) this.#rows.set(job.id, this.#row(job.id));
      const row = this.#rows.get(job.id);
      if (host.children[i] !== row) host.insertBefore(row, host.children[i] ?? null);
      this.#fill(row, job);
    });
    this.#drawer.querySelector('.none').hidden = this.#list.length > 0;
  }

  #row(id) {
    const row = document.createElement('li');
    row.innerHTML =
      '<h3></h3><button type="button" class="text quiet"></button><progress max="1"></progress><p class="state"></p>' +
      '<details><summary>Log</summary><pre tabindex="0"></pre></details>';
    row.querySelector('button').addEventListener('click', () => this.cancel(id));
    row.querySelector('details').addEventListener('toggle', () => this.#log(row, id));
    return row;
  }

  #fill(row, job) {
    row.dataset.state = job.state;
    const [title, button, progress, state] = row.children;
    if (job.link && job.state === 'done') {
      if (!title.firstElementChild)
        title.replaceChildren(
          Object.assign(document.createElement('a'), {
            href: `/${job.link}`,
            textContent: job.title,
          }),
        );
    } else title.textContent = job.title;
    button.textContent = underWay(job) ? 'Cancel' : 'Forget';
    button.setAttribute('aria-label', `${button.textContent}: ${job.title}`);
    progress.value = job.state === 'done' ? 1 : job.progress;
    progress.setAttribute('aria-label', `Progress of ${job.title}`);
    state.textContent = told(job);
    if (underWay(job)) this.#log(row, job.id);
  }

  async #log(row, id) {
    const [details, text] = [row.querySelector('details'), row.querySelector('pre')];
    if (!details.open) return;
    const { log } = await api.job(id).catch(() => ({ log: '' }));
    text.textContent = log || 'It has said nothing.';
  }
}

/** A job's state in a line. @param {api.Job} job */
export function told(job) {
  if (job.state === 'running') return `${percent(job.progress)}, ${job.message || 'starting'}`;
  if (job.error && job.error !== job.state)
    return sentence(job.state === 'failed' ? job.error : `${STATES[job.state]}: ${job.error}`);
  if (job.state === 'done') return `Done in ${Math.max(1, Math.round(job.ended - job.started))} s.`;
  return sentence(STATES[job.state]);
}

/** What the server answered where a job finds something: what it found, or how the job is. */
export function result(body) {
  if (!('job' in body)) return { state: 'ready', found: body };
  const { job } = body;
  if (!job) return { state: 'unasked' };
  return { state: underWay(job) ? 'working' : 'ended', job };
}
