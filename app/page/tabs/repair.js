/** The smallest repair of a run's largest failure, searched by a job: a sentence, and intervals in the timeline. */

/** @import { Trace } from '../data/trace.js' */
/** @import { Timeline } from '../timeline/timeline.js' */
/** @import { SmallestRepair } from '../types/server.js' */
/** @import { Jobs } from '../widgets/jobs.js' */

import { LIVE_PREFIX } from '../core/constants.js';
import { html } from '../core/dom.js';
import * as api from '../data/api.js';
import { JobResults, jobAction, resultText, showJobButton } from '../widgets/job_results.js';

const MAX_RESULTS = 24; // in the cache
const ABOUT =
  'The fewest sensors and the shortest interval to drop or restore so that the largest failure disappears.';

export class Repair {
  #host;
  #timeline;
  /** @type {JobResults<SmallestRepair>} */
  #results;
  /** @type {Trace | null} */
  #trace = null;
  #loading = new AbortController();
  /** @type {SmallestRepair | null} */
  #drawn = null; // in the timeline

  /**
   * @param {HTMLElement} host
   * @param {Jobs} jobs
   * @param {Timeline} timeline displays the failure and the repair
   */
  constructor(host, jobs, timeline) {
    this.#host = host;
    this.#timeline = timeline;
    this.#results = new JobResults(jobs, MAX_RESULTS, (finished) =>
      this.#trace && finished.includes(this.#key) ? this.show(this.#trace) : this.#draw(),
    );
  }

  /** Forgets the run, after the timeline has got another one. */
  clear() {
    [this.#trace, this.#drawn] = [null, null];
  }

  /**
   * Shows the repair of a run, or the state of its search.
   * @param {Trace} trace
   */
  show(trace) {
    this.#trace = trace;
    this.#loading.abort();
    const { signal } = (this.#loading = new AbortController());
    const isLive = trace.selection.data.startsWith(LIVE_PREFIX); // of no data set, which a search needs
    const { kind, no_diagnosis } = trace.header;
    this.#host.hidden = isLive || kind === 'external' || Boolean(no_diagnosis); // no steps without a sensor
    if (this.#host.hidden) return;
    this.#results.load(this.#key, api.repairUrl(trace.selection), signal);
  }

  get #key() {
    return JSON.stringify(this.#trace?.selection);
  }

  #draw() {
    const trace = this.#trace;
    if (!trace || this.#host.hidden) return;
    const entry = this.#results.get(this.#key);
    const result = entry.state === 'ready' ? entry.result : null;
    html('.verdict', this.#host).textContent =
      result?.sentence ?? resultText(entry, { absent: ABOUT, loading: ABOUT });
    showJobButton(html('.doing', this.#host), entry, {
      action: jobAction(entry.state, 'Search'),
      label: entry.state === 'absent' ? 'Find the smallest repair' : '',
      progress: 'Progress of the search for the smallest repair',
      press: () => this.#results.startOrCancel(this.#key, api.repairUrl(trace.selection)),
    });
    if (result !== this.#drawn) this.#timeline.showRepair(result);
    this.#drawn = result;
  }
}
