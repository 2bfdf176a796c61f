/** The finding of the displayed run at the top of the page, with links to its step and its diagnosis. */

/** @import { Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { Finding } from '../step/finding.js' */
/** @import { Diagnosis } from '../types/server.js' */

import { useful } from '../core/common_panels.js';
import { html } from '../core/dom.js';
import * as api from '../data/api.js';
import { finding } from '../step/finding.js';

export class FindingBar {
  #host;
  #store;
  #loading = new AbortController();
  /** That shows the finding best. @type {number | null} */
  step = null;
  /** @type {string | undefined} */
  #component;
  /** Loads the run again, if that failed. @type {(() => void) | null} */
  #retry = null;
  /** @type {Trace | null} */
  #trace = null;

  /**
   * @param {HTMLElement} host
   * @param {Store} store
   */
  constructor(host, store) {
    this.#host = host;
    this.#store = store;
    html('.go-to-step', host).addEventListener('click', ({ timeStamp }) =>
      this.#retry ? this.#retry() : this.goToMoment(timeStamp),
    );
    html('.why', host).addEventListener('click', () =>
      store.set(
        this.#hasDefect
          ? { tab: 'diagnostics', diagnostic: 'equations', options: '' }
          : { tab: 'diagnosis' },
      ),
    );
  }

  /**
   * Shows the finding from the trace alone, and then the preliminary diagnosis.
   * @param {Trace | null} trace null while another one is loading
   */
  async show(trace) {
    this.#loading.abort();
    const { signal } = (this.#loading = new AbortController());
    this.#trace = trace;
    this.#host.classList.toggle('stale', !trace);
    if (!trace) return;
    this.#draw(trace, null);
    if (trace.live || trace.header.no_diagnosis) return;
    await useful;
    if (signal.aborted) return;
    const url = api.diagnosisUrl(trace.selection, 'episode');
    const reply = await api.poll(url, signal).catch(() => null);
    const result = reply && 'job' in reply ? reply.preliminary : reply;
    if (result && !signal.aborted) this.#draw(trace, result);
  }

  /**
   * Shows the confirmed diagnosis of the displayed run.
   * @param {Trace} trace
   * @param {Diagnosis} diagnosis
   */
  confirm(trace, diagnosis) {
    if (trace !== this.#trace) return;
    this.#loading.abort(); // the preliminary one
    this.#draw(trace, diagnosis);
  }

  /**
   * Shows why there is no run.
   * @param {string} reason
   * @param {() => void} retry loads the run again
   */
  fail(reason, retry) {
    const headline = 'This run cannot be displayed.';
    this.#write({ tone: 'bad', headline, evidence: reason, step: null }, 'error', retry);
  }

  /** Whether the finding is a defect in the equations of the filter, which the diagnosis does not have. */
  get #hasDefect() {
    return Boolean(this.#trace?.header.defects?.length);
  }

  /** @param {number} inputTime */
  goToMoment(inputTime) {
    if (this.step === null) return;
    const component = this.#component ?? this.#store.state.component;
    this.#store.set({ step: this.step, component, playing: false }, { inputTime });
  }

  /**
   * @param {Trace} trace
   * @param {Diagnosis | null} diagnosis
   */
  #draw(trace, diagnosis) {
    const { component } = this.#store.state;
    const index = trace.components.findIndex(({ name }) => name === component);
    html('.why', this.#host).textContent = this.#hasDefect ? 'Equations' : 'Diagnosis';
    this.#write(finding(trace, Math.max(index, 0), diagnosis), diagnosis?.state ?? 'trace');
  }

  /**
   * @param {Finding} finding
   * @param {string} source
   * @param {(() => void) | null} [retry]
   */
  #write({ tone, headline, evidence, step, component }, source, retry = null) {
    this.#host.classList.remove('stale');
    [this.#host.dataset.tone, this.#host.dataset.source] = [tone, source];
    const line = html('.sentence', this.#host);
    html('strong', line).textContent = headline;
    html('span', line).textContent = evidence;
    line.title = `${headline} ${evidence}`;
    [this.step, this.#component, this.#retry] = [step, component, retry];
    const button = html('.go-to-step', this.#host);
    button.classList.toggle('none', step === null && !retry);
    button.textContent = retry ? 'Try again' : `Go to step ${step ?? ''}`;
  }
}
