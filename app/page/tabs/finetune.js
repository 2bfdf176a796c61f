/** The Fine-tune tab: a form for a new run, or a run with its progress and its results, and the lineage of the filters. */

/** @import { Store } from '../core/state.js' */
/** @import { FineTuneDetails, FineTuneOffer, Job, Selection } from '../types/server.js' */
/** @import { FaultDialog } from '../widgets/fault_dialog.js' */
/** @import { Jobs } from '../widgets/jobs.js' */
/** @import { Decision } from './finetune_run.js' */

import { element, html, messageOf } from '../core/dom.js';
import { isRecordedOnly } from '../core/episodes.js';
import { permalink } from '../core/state.js';
import * as api from '../data/api.js';
import { isActive } from '../widgets/jobs.js';
import { setPanelState } from '../widgets/panel_state.js';
import { FinetuneForm } from './finetune_form.js';
import { FinetuneRun } from './finetune_run.js';
import { FinetuneRuns } from './finetune_runs.js';
import { showLineage } from './lineage.js';

const BODY = `
  <form novalidate aria-label="Fine-tuning"></form>
  <article hidden tabindex="-1"></article>
  <section class="runs" hidden></section>
  <section class="lineage"></section>
  <p class="note"></p>`;

export class Finetune {
  #host;
  #store;
  #jobs;
  #form;
  #runView;
  #runs;
  /** @type {FineTuneOffer | null} */
  #offer = null;
  #offerKey = ''; // selection of the offer and its weaknesses
  /** @type {FineTuneDetails | null} */
  #run = null;
  #lastJob = ''; // state of the run's job as JSON
  #open = false;
  #loading = new AbortController();
  /** @type {Promise<void>} */
  #current = Promise.resolve();
  #waits = false; // for the end of the current loading

  /**
   * @param {HTMLElement} host
   * @param {Store} store
   * @param {Jobs} jobs
   * @param {FaultDialog} faultDialog
   */
  constructor(host, store, jobs, faultDialog) {
    this.#host = host;
    this.#store = store;
    this.#jobs = jobs;
    host.innerHTML = BODY;
    const form = element('form', HTMLFormElement, host);
    this.#form = new FinetuneForm(form, store, faultDialog, (settings) =>
      this.#start(store.state, settings),
    );
    html('.lineage', host).hidden = true;
    this.#runs = new FinetuneRuns(html('.runs', host), store);
    this.#runView = new FinetuneRun(html('article', host), store, {
      back: () => this.#closeRun(),
      pauseOrResume: () => this.#pauseOrResume(),
      trainLonger: () => this.#trainLonger(),
      decide: (decision, link) => this.#decide(decision, link),
    });
    jobs.listen((list) => this.#followJobs(list));
  }

  /** Whether the tab is selected. */
  set open(/** @type {boolean} */ open) {
    this.#open = open;
    if (open) this.load();
  }

  redraw() {
    this.#runView.redraw();
    this.#runs.redraw();
  }

  /** Loads the options of the selected filter, and the selected run. */
  load() {
    this.#current = this.#load();
  }

  async #load() {
    if (!this.#open) return;
    const { task, filter, data, episode, faults, run } = this.#store.state;
    if (!run && isRecordedOnly(this.#store.catalog, { task, filter, data })) {
      this.#loading.abort();
      const text = `The filter ${filter} is known only from its recorded runs: it has no modules to train.`;
      return setPanelState(this.#host, 'empty', text);
    }
    const key = JSON.stringify([task, filter, data, ...(run ? [] : [episode, faults])]);
    this.#loading.abort();
    const { signal } = (this.#loading = new AbortController());
    try {
      if (key !== this.#offerKey || !this.#offer) {
        setPanelState(this.#host, 'loading', 'Loading the modules of the filter …');
        const offer = await api.finetuneOptions(this.#store.state, signal);
        const { state } = this.#store;
        const weaknesses = offer.why_not || run ? [] : await api.weaknesses(state, signal);
        [this.#offer, this.#offerKey] = [offer, key];
        this.#form.show(offer, weaknesses);
        const { members } = await api.lineage(state.task, signal);
        const task = this.#store.task();
        showLineage(html('.lineage', this.#host), task, state, members);
      }
      this.#run = run ? await api.finetuneRun(run, signal) : null;
      this.#form.hidden = Boolean(this.#run);
      this.#runView.show(this.#run);
      const place = this.#run ? html('.place', this.#host) : null;
      if (place) place.append(html('.runs', this.#host));
      else html('.lineage', this.#host).before(html('.runs', this.#host));
      this.#runs.show(this.#offer.runs, this.#run);
      const { why_not: whyNot } = this.#offer;
      if (whyNot && !run) setPanelState(this.#host, 'empty', whyNot);
      else setPanelState(this.#host, 'ready');
    } catch (error) {
      if (signal.aborted) return;
      if (!(error instanceof api.ServerError)) console.error(error);
      setPanelState(this.#host, 'error', messageOf(error));
    }
  }

  #closeRun() {
    this.#store.set({ run: '' });
    this.#store.flush();
    this.#form.focus();
  }

  #pauseOrResume() {
    const run = this.#run;
    if (!run) return;
    if (run.job && isActive(run.job)) this.#jobs.cancel(run.job.id);
    else this.#start(run, run.settings);
  }

  /** Starts a run with twice the steps of this one. */
  #trainLonger() {
    const run = this.#run;
    if (run) this.#start(run, { ...run.settings, steps: 2 * run.settings.steps });
  }

  /**
   * Starts a run, or resumes the one with the same settings.
   * @param {Pick<Selection, 'task' | 'filter' | 'data'>} selection
   * @param {object} settings
   */
  async #start(selection, settings) {
    this.#form.showError('');
    try {
      const { run } = await api.startFinetune(selection, settings);
      this.#offerKey = ''; // the list of runs has changed
      this.#store.set({ run });
      this.#jobs.refresh();
      this.load();
    } catch (error) {
      if (this.#run) this.#runView.showVerdict(messageOf(error));
      else this.#form.showError(messageOf(error));
    }
  }

  /** @param {Job[]} list */
  #followJobs(list) {
    const id = this.#run?.job?.id;
    const job = JSON.stringify(list.find((item) => item.id === id) ?? null);
    if (!this.#open || !this.#run || job === this.#lastJob) return;
    this.#lastJob = job;
    this.#reload();
  }

  /** Loads again after the current loading, which the frequent changes of a job would never let end on a slow machine. */
  async #reload() {
    if (this.#waits) return;
    this.#waits = true;
    await this.#current;
    this.#waits = false;
    if (!isActive(this.#jobs.find(this.#run?.job?.id))) this.#offerKey = ''; // a run has ended
    this.load();
  }

  /**
   * Promotes, saves or discards the fine-tuned checkpoint, and loads the page again, because the catalog has changed.
   * @param {Decision} decision
   * @param {string} [link] to be opened; by default the page with the checkpoint that is now in use
   */
  async #decide(decision, link) {
    if (!this.#run) return;
    try {
      const { run, filter: base, finetuned } = this.#run;
      await api.decideFinetune(run, decision);
      const { state } = this.#store;
      const isDiscarded = decision === 'discard' && state.filter === finetuned;
      const filter = decision === 'promote' && finetuned ? finetuned : state.filter;
      location.assign(link ?? `/${permalink({ ...state, filter: isDiscarded ? base : filter })}`);
    } catch (error) {
      this.#runView.showVerdict(messageOf(error));
    }
  }
}
