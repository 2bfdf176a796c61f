/** The Diagnosis tab: the probable cause of a fault, with evidence, the effect of undoing it and the next action. */

/** @import { Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { Diagnosis as Result, DiagnosisCause, DiagnosisEvidence, Job } from '../types/server.js' */
/** @import { Jobs, Pending } from '../widgets/jobs.js' */

import { create, html, isAbort, messageOf } from '../core/dom.js';
import { percent, sentence } from '../core/units.js';
import * as api from '../data/api.js';
import { isActive, jobState, jobSummary, pending } from '../widgets/jobs.js';
import { choice } from '../widgets/pickers.js';

/** @typedef {Pending<Result> | {state: 'loading', job?: undefined} | {state: 'error' | 'live', error: string, job?: undefined}} Entry */

/** @type {[string, string][]} */
const OVER = [
  ['episode', 'this episode'],
  ['held-out', 'held-out episodes'],
];
/** Label of the button by state. @type {Partial<Record<Entry['state'], string>>} */
const ACTIONS = { absent: 'Diagnose', ended: 'Try again', error: 'Try again', active: 'Cancel' };
const MAX_RESULTS = 24; // in the cache

export class Diagnosis {
  #host;
  #store;
  #jobs;
  /** @type {Trace | null} */
  #trace = null;
  /** @type {Map<string, Entry>} */
  #entries = new Map();
  #loading = new AbortController();
  #open = false;
  #listed = ''; // key of the listed causes

  /**
   * @param {HTMLElement} host
   * @param {Store} store
   * @param {Jobs} jobs
   */
  constructor(host, store, jobs) {
    this.#host = host;
    this.#store = store;
    this.#jobs = jobs;
    jobs.listen((list) => this.#followJobs(list));
  }

  /** Whether the panel is visible; nothing is requested before. */
  set open(/** @type {boolean} */ open) {
    this.#open = open;
    if (open) this.load();
  }

  /** @param {Trace} trace */
  show(trace) {
    this.#trace = trace;
    this.load();
  }

  /** Loads the diagnosis of the selected run, or the state of its job. */
  async load() {
    const trace = this.#trace;
    if (!this.#open || !trace) return;
    this.#loading.abort();
    const { signal } = (this.#loading = new AbortController());
    const key = this.#key;
    if (trace.live) {
      const error = 'A live run has no diagnosis: its trace holds no data set.';
      this.#cache(key, { state: 'live', error });
      return this.#draw();
    }
    if (!this.#entries.has(key)) this.#cache(key, { state: 'loading' });
    this.#draw();
    if (this.#entry.state === 'ready') return;
    try {
      const reply = await api.diagnosis(trace.selection, this.#store.state.over, signal);
      this.#cache(key, pending(reply));
    } catch (error) {
      if (isAbort(error)) return;
      this.#cache(key, { state: 'error', error: messageOf(error) });
    }
    this.#draw();
  }

  get #key() {
    const { episode, ...names } = this.#trace?.selection ?? {};
    const { over } = this.#store.state;
    return JSON.stringify([names, over === 'episode' ? episode : over]);
  }

  /** @returns {Entry} */
  get #entry() {
    return this.#entries.get(this.#key) ?? { state: 'loading' };
  }

  /**
   * @param {string} key
   * @param {Entry} entry
   */
  #cache(key, entry) {
    this.#entries.delete(key);
    this.#entries.set(key, entry);
    const [oldest] = this.#entries.keys();
    if (this.#entries.size > MAX_RESULTS) this.#entries.delete(oldest);
  }

  async #start() {
    const trace = this.#trace;
    if (!trace) return;
    const key = this.#key;
    try {
      const { job } = await api.startDiagnosis(trace.selection, this.#store.state.over);
      this.#cache(key, jobState(job));
    } catch (error) {
      this.#cache(key, { state: 'error', error: messageOf(error) });
    }
    this.#draw();
    this.#jobs.refresh();
  }

  /**
   * Updates the states of jobs; the result of a finished job is loaded.
   * @param {Job[]} list
   */
  #followJobs(list) {
    for (const [key, { job }] of [...this.#entries]) {
      if (!job) continue;
      const update = list.find(({ id }) => id === job.id) ?? null;
      if (update?.state === 'done') this.#entries.delete(key);
      else this.#cache(key, jobState(update));
    }
    if (this.#entries.has(this.#key)) this.#draw();
    else this.load();
  }

  #draw() {
    if (!this.#open) return;
    const entry = this.#entry;
    const { over } = this.#store.state;
    const set = (/** @type {string} */ value) => this.#store.set({ over: value });
    choice(html('.choice', this.#host), OVER, over, set);
    const result = entry.state === 'ready' ? entry.result : null;
    this.#host.dataset.state = entry.state;
    this.#host.dataset.finding = result ? (result.masked ? 'masked' : result.state) : '';
    this.#host.ariaBusy = String(entry.state === 'loading' || entry.state === 'active');
    const headline = html('.headline', this.#host);
    const text = headlineOf(entry);
    if (headline.textContent !== text) headline.textContent = text;
    this.#drawButton(entry);
    const key = result ? this.#key : '';
    if (key === this.#listed) return;
    this.#listed = key;
    html('.causes', this.#host).replaceChildren(
      ...(result?.causes ?? []).map((cause) => this.#row(cause)),
    );
    html('.about', this.#host).textContent = result ? aboutOf(result) : '';
  }

  /** @param {Entry} entry */
  #drawButton(entry) {
    const host = html('.doing', this.#host);
    const action = ACTIONS[entry.state] ?? '';
    if (host.dataset.action !== action) {
      const hadFocus = host.contains(document.activeElement);
      host.dataset.action = action;
      const button = create('button', { type: 'button', className: 'text', textContent: action });
      button.addEventListener('click', () => {
        const { job } = this.#entry;
        if (job && isActive(job)) this.#jobs.cancel(job.id);
        else this.#start();
      });
      const progress = create('progress', { ariaLabel: 'Progress of the diagnosis' });
      host.replaceChildren(
        ...(entry.state === 'active' ? [progress] : []),
        ...(action ? [button] : []),
      );
      if (hadFocus && action) button.focus();
    }
    const progress = host.querySelector('progress');
    if (progress) progress.value = entry.job?.progress ?? 0;
  }

  /** @param {DiagnosisCause} cause */
  #row(cause) {
    const { probability, recovered, evidence, steps } = cause;
    const bar = create('meter', { min: 0, max: 1, value: probability });
    bar.setAttribute('aria-label', `Probability of ${cause.cause}`);
    const where = [`episodes ${cause.episodes.join(', ')}`];
    if (steps) where.push(`steps ${steps[0]} to ${steps[1] - 1}`);
    const lines = [
      create('p', { className: 'where', textContent: sentence(where.join(', ')) }),
      create('ul', {}, ...evidence.map((item) => this.#evidence(item))),
    ];
    if (recovered) lines.push(create('p', { textContent: recoveredText(recovered) }));
    lines.push(create('p', { textContent: `Next: ${cause.next}` }));
    return create(
      'li',
      {},
      create('h4', { textContent: cause.cause }),
      bar,
      create('output', { textContent: probability.toFixed(2) }),
      create('div', { className: 'details' }, ...lines),
    );
  }

  /** @param {DiagnosisEvidence} evidence */
  #evidence({ text, episode, step }) {
    const item = create('li', { textContent: sentence(text) });
    if (episode === null) return item;
    const label = step === null ? `episode ${episode}` : `episode ${episode}, step ${step}`;
    const link = create('button', { type: 'button', className: 'text quiet', textContent: label });
    link.addEventListener('click', () =>
      this.#store.set({ episode, step: step ?? 0, playing: false }),
    );
    item.append(' ', link);
    return item;
  }
}

/** @param {Entry} entry */
function headlineOf(entry) {
  if (entry.state === 'ready') return entry.result.headline;
  if (entry.state === 'error' || entry.state === 'live') return sentence(entry.error);
  if (entry.state === 'active' || entry.state === 'ended') return jobSummary(entry.job);
  if (entry.state === 'loading') return 'Loading …';
  return 'No diagnosis yet. It compares sensors, labels, modules and filter with the healthy record.';
}

/** @param {Result} result */
function aboutOf({ episodes, healthy_episodes: healthy, alarm_rate: rate }) {
  const text = `${episodes} ${episodes === 1 ? 'episode' : 'episodes'} against ${healthy} healthy ones`;
  return `${text}; a healthy filter is accused with a probability of ${percent(rate)}.`;
}

/** @param {NonNullable<DiagnosisCause['recovered']>} recovered */
function recoveredText({ error, low, high, nll }) {
  const likelihood = `the negative log-likelihood decreases by ${nll === null ? '?' : nll.toFixed(2)} nats a step`;
  if (error === null) return `If undone, ${likelihood}.`;
  const range = low === null || high === null ? '' : ` (${percent(low)} to ${percent(high)})`;
  return `Undoing it recovers ${percent(error)}${range} of the excess error; ${likelihood}.`;
}
