/** The Failures tab: failure events over a data set, its episodes, or slices with larger errors. The search is a job. */

/** @import { State, Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { Timeline } from '../timeline/timeline.js' */
/** @import { FailureEvent, FailureScore, Failures as Search } from '../types/server.js' */
/** @import { JobResult } from '../widgets/job_results.js' */
/** @import { Jobs } from '../widgets/jobs.js' */

import { LIVE_PREFIX } from '../core/constants.js';
import { element, html } from '../core/dom.js';
import { fixed, percent, sentence, significant } from '../core/units.js';
import * as api from '../data/api.js';
import { JobResults, jobAction, resultText, showJobButton } from '../widgets/job_results.js';
import { choice } from '../widgets/pickers.js';
import { Episodes } from './episodes.js';
import { EventTable } from './event_table.js';
import { formatScore, scoreName, viewOf } from './failure_scores.js';
import { SliceTable } from './slice_table.js';

const LISTS = { events: 'Events', episodes: 'Episodes', slices: 'Slices' };
const AMONG = { 'held-out': 'held-out', all: 'all' };
const STATES = {
  live: 'The live run is in progress. Its failures are listed when it has ended.',
  absent: 'No search yet. A search runs the filter over the episodes selected above.',
};
const SLICES_NOTE =
  'A slice is one condition, or two, under which the score is larger, tested over episodes. A click opens its worst step.';
const MAX_RESULTS = 8; // in the cache

/**
 * Result of the search for failures of a filter over a data set; `live`: available after the end of the live run.
 * @typedef {JobResult<Search> | {state: 'live', job?: undefined}} Result
 */

export class Failures {
  #host;
  #store;
  #timeline;
  #episodes;
  #table;
  #slices;
  /** @type {Trace | null} */
  #trace = null;
  /** @type {JobResults<Search>} */
  #results;
  #loading = new AbortController();
  #last = -1; // index of the event opened last
  #tableKey = ''; // of the listed events
  #targetKey = ''; // of the result whose worst event is opened when it is available

  /**
   * @param {HTMLElement} host
   * @param {Store} store
   * @param {Jobs} jobs
   * @param {Timeline} timeline displays marks of the events
   */
  constructor(host, store, jobs, timeline) {
    this.#host = host;
    this.#store = store;
    this.#timeline = timeline;
    this.#episodes = new Episodes(element('.episodes', HTMLTableElement, host), store);
    this.#table = new EventTable(element('.events', HTMLTableElement, host), (event, time) =>
      this.#open(event, time),
    );
    this.#slices = new SliceTable(element('.slices', HTMLTableElement, host), (worst, time) =>
      this.#open(worst, time),
    );
    this.#results = new JobResults(jobs, MAX_RESULTS, (finished) =>
      finished.includes(this.#key) ? this.load() : this.draw(),
    );
    this.load();
  }

  /** @param {Trace | null} trace displayed in the timeline; null while there is none */
  show(trace) {
    this.#trace = trace;
    if (!this.#isLive) return this.#markTimeline();
    this.#results.delete(this.#key); // a new live run can have the same name
    this.load();
  }

  /**
   * Highlights the event at the cursor.
   * @param {number} step
   */
  move(step) {
    const { episode } = this.#store.state;
    /** @param {FailureEvent} event */
    const isCurrent = (event) => event.episode === episode && event.step === step;
    const index = this.#events.findIndex(isCurrent);
    if (index >= 0) this.#last = index;
    if (this.#host.hidden) return;
    this.#table.mark(isCurrent);
    this.#slices.mark(episode, step);
  }

  /** Loads the result for the current selection. */
  async load() {
    this.#loading.abort();
    const { signal } = (this.#loading = new AbortController());
    const key = this.#key;
    this.#last = -1;
    if (this.#targetKey !== key) this.#targetKey = '';
    if (this.#liveState) return this.draw();
    await this.#results.load(key, api.failuresUrl(this.#store.state), signal);
    if (signal.aborted) return;
    this.#openTarget();
  }

  /**
   * Opens the next or the previous event.
   * @param {1 | -1} by
   * @param {number | null} [inputTime]
   * @returns {string} announcement of another episode; empty if the event is in the same one
   */
  go(by, inputTime = null) {
    const events = this.#events;
    if (!events.length) {
      this.#store.set({ tab: 'failures' });
      return '';
    }
    this.#last = Math.min(Math.max(this.#last + by, 0), events.length - 1);
    const event = events[this.#last];
    const { episode } = this.#store.state;
    this.#open(event, inputTime);
    this.#table.point(this.#last);
    return episodeNote(event, episode, `${this.#last + 1} of ${events.length}`);
  }

  /** Opens the worst event once it is known; starts the search if necessary. */
  goToWorst() {
    this.#targetKey = this.#key;
    this.#openTarget();
  }

  #openTarget() {
    if (this.#targetKey !== this.#key) return;
    const { state } = this.#result;
    if (state === 'absent') this.#searchOrCancel();
    if (state !== 'ready') return;
    this.#targetKey = '';
    this.#last = -1;
    this.go(1);
  }

  /** Shows the result for the selected score; only its marks in the timeline if the tab is not selected. */
  draw() {
    this.#markTimeline();
    if (this.#host.hidden) return;
    const { state } = this.#store;
    const result = this.#result;
    const score = this.#score;
    const failures = result.state === 'ready' ? result.result : undefined;
    /** @param {'list' | 'among'} key */
    const set = (key) => (/** @type {string} */ value) => this.#store.set({ [key]: value });
    choice(html('#list', this.#host), LISTS, state.list, set('list'));
    choice(html('#among', this.#host), this.#isLive ? [] : AMONG, state.among, set('among'));
    for (const name of Object.keys(LISTS))
      html(`.${name}`, this.#host).hidden = state.list !== name;
    this.#host.dataset.state = result.state;
    this.#host.ariaBusy = String(result.state === 'loading' || result.state === 'active');
    showJobButton(html('.doing', this.#host), result, {
      action: jobAction(result.state, 'Search for failures'),
      progress: 'Progress of the search for failures',
      press: () => this.#searchOrCancel(),
      next: html('.scroll', this.#host),
    });
    this.#drawScores(failures?.scores ?? []);
    const text = score ? scoreSummary(score, state.list) : resultText(result, STATES);
    const verdict = html('.verdict', this.#host);
    if (verdict.textContent !== text) verdict.textContent = verdict.title = text;
    this.#drawPhases(score);
    this.#slices.show(score, failures?.episodes.length ?? 0);
    this.#drawTable(failures, score);
    this.#episodes.show(failures ?? null, score && !score.why_not ? score : null);
  }

  get #key() {
    const { task, filter, data, faults, among } = this.#store.state;
    return JSON.stringify([task, filter, data, faults, among]);
  }

  get #isLive() {
    return this.#store.state.data.startsWith(LIVE_PREFIX);
  }

  /** State of a live run that is not complete; null for any other run. @returns {Result | null} */
  get #liveState() {
    if (!this.#isLive) return null;
    if (this.#trace?.selection.data !== this.#store.state.data) return { state: 'loading' };
    return this.#trace.live?.state === 'running' ? { state: 'live' } : null;
  }

  /** @returns {Result} */
  get #result() {
    return this.#liveState ?? this.#results.get(this.#key);
  }

  /** The selected score, or the first one if the task does not have it. @returns {FailureScore | undefined} */
  get #score() {
    const result = this.#result;
    if (result.state !== 'ready') return undefined;
    const { scores } = result.result;
    return scores.find(({ name }) => name === this.#store.state.by) ?? scores[0];
  }

  /** The selected phase; undefined if the score does not have it. */
  get #phase() {
    return this.#score?.phases?.find(({ name }) => name === this.#store.state.phase);
  }

  /** Events of the score in the selected phase. */
  get #events() {
    const events = this.#score?.events ?? [];
    const phase = this.#phase;
    return phase ? events.filter((event) => event.phase === phase.name) : events;
  }

  #searchOrCancel() {
    this.#results.startOrCancel(this.#key, api.failuresUrl(this.#store.state));
  }

  /**
   * Shows all scores. An unavailable one can be selected as well, which shows the reason.
   * @param {FailureScore[]} scores
   */
  #drawScores(scores) {
    const host = html('#by', this.#host);
    choice(
      host,
      scores.map((score) => [score.name, scoreName(score)]),
      this.#score?.name ?? '',
      (by) => this.#store.set({ by, ...viewOf(by, this.#trace) }),
    );
    scores.forEach(({ title, why_not: whyNot }, i) => {
      const label = html(`label:nth-of-type(${i + 1})`, host);
      label.title = whyNot ? `${sentence(title)} Not available: ${whyNot}.` : `Rank by ${title}`;
      label.classList.toggle('unavailable', Boolean(whyNot));
    });
  }

  /** @param {FailureScore | undefined} score */
  #drawPhases(score) {
    const host = html('#phase', this.#host);
    const phases = (score?.phases ?? []).filter(({ events }) => events);
    const selected = phases.find(({ name }) => name === this.#store.state.phase)?.name ?? '';
    /** @type {[string, string][]} */
    const options = phases.map(({ name, events, lift, over_represented: isOver }) => [
      name,
      `${name} ${events}${isOver ? ` · lift ${fixed(lift)}` : ''}`,
    ]);
    choice(host, [['', `all ${score?.total ?? ''}`], ...options], selected, (phase) =>
      this.#store.set({ phase }),
    );
    host.hidden = !phases.length || this.#store.state.list !== 'events';
    phases.forEach((phase, i) => {
      const label = html(`label:nth-of-type(${i + 2})`, host);
      label.classList.toggle('over-represented', phase.over_represented);
      const shares = `${percent(phase.share)} of the steps, ${percent(phase.event_share)} of the events`;
      label.title = `${shares}: lift ${fixed(phase.lift)}, p-value ${significant(phase.p_value)}`;
    });
  }

  /**
   * @param {Search | undefined} failures
   * @param {FailureScore | undefined} score
   */
  #drawTable(failures, score) {
    const events = this.#events;
    const key = failures && score ? `${this.#key} ${score.name} ${this.#store.state.phase}` : '';
    if (key !== this.#tableKey) {
      this.#tableKey = key;
      this.#table.show(failures, score, events);
      html('.scroll', this.#host).scrollTop = 0;
      this.#last = -1;
    }
    const total = this.#phase?.events ?? score?.total ?? 0;
    const limit = `${events.length} of ${total} listed: those among the worst ${score?.events?.length} of all phases.`;
    const { list, step } = this.#store.state;
    const notes = { events: events.length < total ? limit : '', slices: score ? SLICES_NOTE : '' };
    html('.rest', this.#host).textContent = notes[/** @type {keyof notes} */ (list)] ?? '';
    this.move(step);
  }

  /**
   * @param {{episode: number, step: number}} event
   * @param {number | null} inputTime
   */
  #open({ episode, step }, inputTime) {
    this.#store.set({ episode, step, playing: false }, { inputTime });
  }

  /** Marks the listed events of the displayed episode in the timeline. */
  #markTimeline() {
    if (!this.#trace) return;
    const score = this.#score;
    const { episode } = this.#trace.selection;
    const events = score ? this.#events.filter((event) => event.episode === episode) : [];
    this.#timeline.mark(
      events.map(({ step, value, phase, time }) => ({
        step,
        time,
        label: score ? `${score.title} ${formatScore(score, value)}, ${phase}` : '',
        measure: score?.title,
      })),
    );
  }
}

/**
 * Announces that a failure is in another episode; empty if it is not.
 * @param {Pick<FailureEvent, 'episode' | 'step'>} event
 * @param {number} previous displayed episode
 * @param {string} rank
 */
export const episodeNote = ({ episode, step }, previous, rank) =>
  episode === previous
    ? ''
    : `Failure ${rank} is in episode ${episode}, step ${step}. ctrl z returns to episode ${previous}.`;

/**
 * @param {FailureScore} score
 * @param {string} list
 */
function scoreSummary(score, list) {
  if (score.why_not) return `No ${scoreName(score)}: ${score.why_not}.`;
  return (list === 'slices' ? score.slices?.summary : score.verdict) ?? '';
}
