/** The Diagnosis tab: the probable cause of a fault, with evidence, the effect of undoing it and the next action. */

/** @import { Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { Timeline } from '../timeline/timeline.js' */
/** @import { Diagnosis as Result, DiagnosisCause, HealthyRecord } from '../types/server.js' */
/** @import { JobResult } from '../widgets/job_results.js' */
/** @import { Jobs } from '../widgets/jobs.js' */

import { LIVE_PREFIX, SHOWN } from '../core/constants.js';
import { create, createButton, html, pause, setOptions } from '../core/dom.js';
import { sentence } from '../core/units.js';
import * as api from '../data/api.js';
import { affectedComponent, largestErrorStep } from '../step/finding.js';
import { readingCharts } from '../timeline/reading_charts.js';
import { JobResults, jobAction, resultText, showJobButton } from '../widgets/job_results.js';
import { choice } from '../widgets/pickers.js';
import {
  EPISODES,
  causeItem,
  evidenceItem,
  isTrainable,
  largestError,
  withCode,
} from './diagnosis_cause.js';
import { aboutOf, findingOf, wholeOptions } from './diagnosis_text.js';
import { liveRunState } from './live_runs.js';
import { Repair } from './repair.js';

/** @typedef {JobResult<Result> | {state: 'live', job?: undefined, preliminary?: undefined}} Entry */

const OVER = { episode: 'this episode', 'held-out': 'held-out episodes' };
/** Of live and imported runs. */
const OVER_RUNS = { episode: 'this run', 'held-out': 'all its runs' };
const UNLIKELY = `Every cause of the catalog has a probability below ${SHOWN} or no evidence.`;
const WITHIN =
  'The largest deviations of all statistics; healthy episodes also have some outside these ranges.';
const LIVE = { live: 'The live run is in progress. It is diagnosed when it has ended.' };
const MEASURE = 'Measure a healthy record';
const MAX_RESULTS = 24; // in the cache
const SETTLING = { open: 500, closed: 2000 }; // ms until the job of a selection starts

export class Diagnosis {
  #host;
  #store;
  #starts;
  #repair;
  /** @type {Trace | null} */
  #trace = null;
  /** @type {JobResults<Result>} */
  #results;
  /** @type {JobResults<HealthyRecord>} for filters without a record */
  #records;
  /** @type {Set<string>} keys of records after which the run was loaded again */
  #announced = new Set();
  #healthyFilter = ''; // runs over the episodes of a record; empty: the displayed filter
  #loading = new AbortController();
  #failure = ''; // why there is no run
  #open = false;
  /** @type {Result | null | undefined} */
  #listed; // result whose causes are listed
  /** Called with the confirmed diagnosis of the displayed episode. @type {(trace: Trace, result: Result) => void} */
  confirmed = () => {};
  /** Called when the displayed filter has got a healthy record, so that its runs are diagnosed. */
  recorded = () => {};

  /**
   * @param {HTMLElement} host
   * @param {Store} store
   * @param {Jobs} jobs
   * @param {Timeline} timeline displays the smallest repair
   */
  constructor(host, store, jobs, timeline) {
    this.#host = host;
    this.#store = store;
    this.#starts = !store.catalog.read_only;
    this.#repair = new Repair(html('.repair', host), jobs, timeline);
    this.#results = new JobResults(jobs, MAX_RESULTS, (finished) =>
      finished.includes(this.#key) ? this.load() : this.#draw(),
    );
    this.#records = new JobResults(jobs, MAX_RESULTS, (finished) => this.#followRecords(finished));
    for (const select of this.#healthyFilters)
      select.addEventListener('change', () => {
        this.#healthyFilter = select.value;
        this.load();
      });
    html('.gain', host).addEventListener('click', ({ target }) => {
      const { diagnostic } = /** @type {HTMLElement} */ (target).dataset;
      if (diagnostic) store.set({ tab: 'diagnostics', diagnostic, options: '' });
    });
  }

  /** Whether the panel is visible. The diagnosis of the displayed episode is also requested before, for the finding. */
  set open(/** @type {boolean} */ open) {
    this.#open = open;
    if (open) this.load();
  }

  /** @param {Trace | null} trace null while another one is loading */
  show(trace) {
    if (trace?.selection.filter !== this.#trace?.selection.filter) this.#healthyFilter = '';
    this.#trace = trace;
    this.#failure = '';
    if (this.#isLive) this.#results.delete(this.#key); // a new live run can have the same name
    this.#repair.clear();
    this.#loading.abort();
    this.load();
  }

  /**
   * Shows why there is no run.
   * @param {string} reason
   */
  fail(reason) {
    this.#failure = reason;
    this.#draw();
  }

  /** Loads the diagnosis of the selected run, or a preliminary one and the state of its job, which it starts. */
  async load() {
    const [trace, isOpen] = [this.#trace, this.#open];
    if (!trace) return;
    this.#loading.abort();
    if (
      !isOpen &&
      (!this.#canStart || trace.header.no_diagnosis || this.#store.state.over !== 'episode')
    )
      return;
    const { signal } = (this.#loading = new AbortController());
    if (isOpen) this.#repair.show(trace);
    if (this.#liveState) return this.#draw();
    if (trace.header.no_diagnosis) return this.#loadRecord(trace, signal);
    if (isOpen && !this.#isLive)
      this.#records.load(this.#recordKey, this.#recordUrl(trace), signal);
    const url = api.diagnosisUrl(trace.selection, this.#store.state.over);
    await this.#results.load(this.#key, url, signal);
    if (this.#entry.state !== 'absent' || !this.#canStart) return;
    await pause(isOpen ? SETTLING.open : SETTLING.closed);
    if (!signal.aborted && this.#entry.state === 'absent') this.#startOrCancel();
  }

  /**
   * Loads the healthy record of a filter that had none when it ran, or the state of its job.
   * @param {Trace} trace
   * @param {AbortSignal} signal
   */
  async #loadRecord(trace, signal) {
    const key = this.#recordKey;
    await this.#records.load(key, this.#recordUrl(trace), signal);
    if (signal.aborted || this.#records.get(key).state !== 'ready' || this.#announced.has(key))
      return;
    this.#announced.add(key);
    this.recorded();
  }

  /**
   * Loads the run again, with its diagnosis, after a new measurement of the healthy record of its filter.
   * @param {string[]} finished keys of measured records
   */
  #followRecords(finished) {
    if (!finished.length) return this.#draw();
    this.#results.clear(); // diagnoses against earlier records
    const hasDiagnosis = this.#trace && !this.#trace.header.no_diagnosis;
    if (hasDiagnosis && finished.includes(this.#recordKey)) this.recorded();
    else this.load();
  }

  get #recordKey() {
    const { task, filter, data } = this.#trace?.selection ?? {};
    return JSON.stringify([task, filter, data, this.#healthyFilter]);
  }

  /** @param {Trace} trace */
  #recordUrl({ selection }) {
    return api.recordUrl(selection, this.#healthyFilter);
  }

  /** @returns {NodeListOf<HTMLSelectElement>} */
  get #healthyFilters() {
    return this.#host.querySelectorAll('.healthy-filter select');
  }

  get #key() {
    const { episode, ...names } = this.#trace?.selection ?? {};
    const { over } = this.#store.state;
    return JSON.stringify([names, over === 'episode' ? episode : over]);
  }

  /** Whether the run is or was a live run: it belongs to no data set. */
  get #isLive() {
    return this.#trace?.selection.data.startsWith(LIVE_PREFIX) ?? false;
  }

  /** Whether a job can confirm the diagnosis: that of a live run alone remains preliminary. */
  get #canStart() {
    return this.#starts && !(this.#isLive && this.#store.state.over === 'episode');
  }

  /** State of a live run without a diagnosis; null for any other run. @returns {Entry | null} */
  get #liveState() {
    if (this.#trace?.live?.state === 'running') return { state: 'live' };
    const reason = this.#isLive && this.#trace?.header.no_diagnosis;
    return reason ? { state: 'error', error: reason } : null;
  }

  /** @returns {Entry} */
  get #entry() {
    if (this.#failure) return { state: 'error', error: this.#failure };
    return this.#liveState ?? this.#results.get(this.#key);
  }

  #startOrCancel() {
    const trace = this.#trace;
    if (!trace) return;
    const url = api.diagnosisUrl(trace.selection, this.#store.state.over);
    this.#results.startOrCancel(this.#key, url);
  }

  #draw() {
    const { over } = this.#store.state;
    const entry = this.#entry;
    if (this.#trace && entry.state === 'ready' && over === 'episode')
      this.confirmed(this.#trace, entry.result);
    if (!this.#open) return;
    if (this.#trace && !this.#liveState && this.#trace.header.no_diagnosis)
      return this.#drawRecord(this.#trace, this.#trace.header.no_diagnosis);
    const set = (/** @type {string} */ value) => this.#store.set({ over: value });
    choice(html('.choice', this.#host), this.#isLive ? OVER_RUNS : OVER, over, set);
    const result = entry.state === 'ready' ? entry.result : entry.preliminary;
    this.#host.dataset.state = entry.state;
    this.#host.dataset.finding = result ? findingOf(result) : '';
    this.#host.ariaBusy = String(entry.state === 'loading' || entry.state === 'active');
    const state = resultText(entry, LIVE);
    this.#writeHeadline(result?.headline ?? state);
    const { episode } = this.#store.state;
    const alone = over === 'episode';
    const displayed = this.#isLive ? 'this run' : `episode ${episode}`;
    const preliminary =
      this.#isLive && alone
        ? 'From this run alone: no cause is undone.'
        : `Preliminary, from ${displayed} alone and before any cause is undone.`;
    html('.status', this.#host).textContent = entry.preliminary ? `${preliminary} ${state}` : '';
    showJobButton(html('.doing', this.#host), entry, {
      action: this.#trace && !(this.#isLive && alone) ? jobAction(entry.state, 'Diagnose') : '',
      progress: 'Progress of the diagnosis',
      press: () => this.#startOrCancel(),
      next: html('.scroll', this.#host),
    });
    html('.healthy-filter', this.#host).hidden = true; // of a filter without a record
    this.#drawMeasured(result);
    if (result === this.#listed) return;
    this.#listed = result;
    const causes = (result?.causes ?? []).filter(
      ({ probability, evidence }) => probability >= SHOWN && evidence.length > 0,
    );
    const names = this.#namesOf(result);
    const charts = readingCharts(this.#store, () => this.#trace);
    /** @type {(cause?: DiagnosisCause) => import('./diagnosis_cause.js').OpenStep} */
    const open = (cause) => (e, s) => this.#openStep(e, s, cause);
    const rows = causes.map((cause, i) => {
      const canTrain = this.#canStart && !this.#isLive && !i && isTrainable(cause);
      return causeItem(cause, names, open(cause), charts, canTrain ? [this.#finetuneButton()] : []);
    });
    html('.causes', this.#host).replaceChildren(...rows);
    const deviations = causes.length ? [] : (result?.deviations ?? []);
    html('.deviations', this.#host).hidden = !deviations.length;
    const items = [...largestError(result), ...deviations].map((item) =>
      evidenceItem(item, names, open(), charts),
    );
    html('.deviations ul', this.#host).replaceChildren(...items);
    const isHealthy = result?.state === 'healthy';
    html('.deviations p', this.#host).textContent = isHealthy ? WITHIN : UNLIKELY;
    html('.gain', this.#host).hidden = !isHealthy || !this.#trace?.fuses;
    html('.about', this.#host).replaceChildren(...wholeOptions(result ? aboutOf(result) : ''));
  }

  /**
   * Returns how texts name the episodes of a result; null if it is about the displayed one alone.
   * @param {Result | null | undefined} result
   * @returns {import('./diagnosis_cause.js').Names | null}
   */
  #namesOf(result) {
    const runs = result?.runs;
    if (runs) return { noun: 'run', name: (index) => runs[index].slice(LIVE_PREFIX.length) };
    return this.#isLive || this.#store.state.over === 'episode' ? null : EPISODES;
  }

  /**
   * Opens the step of an evidence, and charts the component whose error the cause increases. Evidence about a whole
   * episode opens its first step, or where the error of the displayed episode is largest.
   * @param {number} episode
   * @param {number | null} step
   * @param {DiagnosisCause} [cause]
   */
  #openStep(episode, step, cause) {
    const { state, catalog } = this.#store;
    const name = this.#listed?.runs?.[episode];
    const run = this.#store.task()?.data.find((set) => set.name === name)?.live;
    if (name && !run) return; // deleted
    const isDisplayed = run ? name === state.data : episode === state.episode;
    const trace = isDisplayed ? this.#trace : null;
    const worst = trace && largestErrorStep(trace);
    const component = affectedComponent(this.#trace?.components ?? [], cause) ?? state.component;
    const selection = run && !isDisplayed ? liveRunState(catalog, run, state) : {};
    const index = run ? run.episode : episode;
    const position = { episode: index, step: step ?? worst ?? 0, component, playing: false };
    this.#store.set({ ...selection, ...position });
  }

  /**
   * Shows why there is no diagnosis, and the measurement of a healthy record.
   * @param {Trace} trace
   * @param {string} reason
   */
  #drawRecord(trace, reason) {
    const entry = this.#records.get(this.#recordKey);
    this.#host.dataset.state = entry.state;
    this.#host.dataset.finding = '';
    this.#host.ariaBusy = String(entry.state === 'active');
    choice(html('.choice', this.#host), [], '', () => {});
    const isReady = entry.state === 'ready'; // the run is loading again
    this.#writeHeadline(isReady ? 'Loading …' : sentence(reason));
    const { task, data } = trace.selection;
    const sets = this.#store.task(task)?.data ?? [];
    const other = sets.length > 1 ? ' If they are not, choose another data set above first.' : '';
    const about = `Runs the filter over the held-out episodes of ${data}, which must be healthy.${other} This and later episodes are then compared with them. More held-out episodes mean fewer false alarms for a single episode.`;
    const state = this.#starts
      ? resultText(entry) || about
      : 'Read-only server: the record cannot be measured here.';
    html('.status', this.#host).textContent = isReady ? '' : state;
    this.#drawHealthyFilter(this.#host, trace, entry);
    showJobButton(html('.doing', this.#host), entry, {
      action: this.#starts ? jobAction(entry.state, MEASURE) : '',
      progress: 'Progress of the healthy record',
      press: () => this.#records.startOrCancel(this.#recordKey, this.#recordUrl(trace)),
      next: html('.scroll', this.#host),
    });
  }

  /**
   * Shows the action that measures a record of the workspace again, or one that replaces the record stored with a
   * checkpoint by an earlier version; none for other stored records.
   * @param {Result | null | undefined} result
   */
  #drawMeasured(result) {
    const host = html('.record', this.#host);
    const entry = this.#records.get(this.#recordKey);
    const isInUse = entry.state === 'ready' && entry.result.data === result?.healthy_data;
    const trace = this.#trace;
    const isOld = result?.outdated ?? false;
    const isShown = isInUse || isOld || ['active', 'ended', 'error'].includes(entry.state);
    host.hidden = !this.#canStart || this.#isLive || !isShown;
    if (host.hidden || !trace) return;
    const { data } = trace.selection;
    const source = isOld
      ? 'The healthy record lacks some statistics of this version.'
      : 'The record was measured in this workspace; it hides faults that its own episodes contain.';
    const about = `${source} Another measurement, over the held-out episodes of ${data}, replaces it; these must be healthy.`;
    html('.verdict', host).textContent = resultText(entry) || (isInUse || isOld ? about : '');
    this.#drawHealthyFilter(host, trace, entry);
    showJobButton(html('.doing', host), entry, {
      action: entry.state === 'active' ? 'Cancel' : 'Measure again',
      progress: 'Progress of the healthy record',
      press: () => this.#records.startOrCancel(this.#recordKey, this.#recordUrl(trace)),
      next: html('.scroll', this.#host),
    });
  }

  /**
   * Shows the choice of the filter that runs over the healthy episodes, if the task has others.
   * @param {HTMLElement} host
   * @param {Trace} trace
   * @param {JobResult<HealthyRecord>} entry
   */
  #drawHealthyFilter(host, trace, entry) {
    const { task, filter } = trace.selection;
    const filters = this.#store.task(task)?.filters ?? [];
    const others = filters.filter(({ name, live }) => name !== filter && !live);
    const label = html('.healthy-filter', host);
    label.hidden = !this.#starts || !others.length || entry.state === 'active';
    const select = /** @type {HTMLSelectElement} */ (html('select', label));
    const options = [['', 'this filter'], ...others.map(({ name }) => [name, name])];
    setOptions(select, options, this.#healthyFilter);
  }

  /** @param {string} text */
  #writeHeadline(text) {
    const headline = html('.headline', this.#host);
    if (headline.dataset.text !== text) headline.replaceChildren(...withCode(text));
    headline.dataset.text = text;
  }

  #finetuneButton() {
    const open = () => this.#store.set({ tab: 'finetune', run: '' });
    const title = 'Set up a fine-tuning run for this cause';
    return createButton('text', 'Fine-tune the filter …', open, { title });
  }
}
