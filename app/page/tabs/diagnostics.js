/** Diagnostics of the current run or of all held-out episodes: a list with their verdicts, or one with its figures. */

/** @import { Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { DiagnosticResult, TraceDiagnosticInfo } from '../types/server.js' */
/** @import { JobResult } from '../widgets/job_results.js' */
/** @import { Jobs } from '../widgets/jobs.js' */

import { LIVE_PREFIX } from '../core/constants.js';
import { create, createButton, element, focusedIn, html, isAbort, messageOf } from '../core/dom.js';
import { typeset } from '../core/units.js';
import * as api from '../data/api.js';
import { Figures } from '../widgets/figures.js';
import { JobResults, jobAction, resultText, showJobButton } from '../widgets/job_results.js';
import { setPanelState } from '../widgets/panel_state.js';
import { choice } from '../widgets/pickers.js';

/**
 * Result of a diagnostic with its options, or why there is none.
 * @typedef {JobResult<DiagnosticResult> | {state: 'refused', error: string, job?: undefined}} Result
 */

const OVER = { episode: 'this episode', 'held-out': 'all held-out' };
/** Of live and imported runs. */
const OVER_RUNS = { episode: 'this run', 'held-out': 'all its runs' };
const MAX_RESULTS = 48;
const STATES = { absent: 'Slow: computed on request.', loading: 'Computing …' };

export class Diagnostics {
  #host;
  #store;
  #figures;
  #list;
  #article;
  #form;
  #backButton;
  /** @type {Trace | null} */
  #trace = null;
  /** @type {TraceDiagnosticInfo[]} */
  #entries = [];
  /** @type {Map<string, HTMLElement>} */
  #rows = new Map();
  /** @type {JobResults<DiagnosticResult>} */
  #results;
  #loading = new AbortController();
  #open = false;
  #stale = true; // whether the entries are those of another trace

  /**
   * @param {HTMLElement} host
   * @param {Store} store
   * @param {Jobs} jobs
   */
  constructor(host, store, jobs) {
    this.#host = host;
    this.#store = store;
    this.#figures = new Figures(html('.figures', host), store);
    this.#list = html('.list', host);
    this.#article = html('article', host);
    this.#form = element('form', HTMLFormElement, host);
    this.#backButton = html('#all-diagnostics', host);
    this.#backButton.addEventListener('click', () => {
      const row = this.#rows.get(store.state.diagnostic);
      store.set({ diagnostic: '', options: '' });
      store.flush();
      if (row) html('.title', row).focus();
    });
    this.#form.addEventListener('submit', (event) => (event.preventDefault(), this.#setOptions()));
    this.#form.addEventListener('change', () => this.#setOptions());
    this.#results = new JobResults(jobs, MAX_RESULTS, (finished) =>
      this.#update(finished.length > 0),
    );
    setPanelState(host, 'loading', 'Loading …');
  }

  /** Whether the panel is visible; nothing is requested before. */
  set open(/** @type {boolean} */ open) {
    this.#open = open;
    if (open) this.#load();
  }

  /** @param {Trace} trace */
  show(trace) {
    this.#trace = trace;
    this.#stale = true;
    this.#load();
  }

  /** @param {string} reason why no run is displayed */
  fail(reason) {
    this.#loading.abort();
    this.#trace = null;
    this.#stale = true;
    setPanelState(this.#host, 'empty', reason);
  }

  /** @param {number} step */
  move(step) {
    if (this.#open && this.#store.state.diagnostic) this.#figures.move(step);
  }

  redraw() {
    this.#figures.redraw();
  }

  /** Shows the diagnostic, options and episodes of the state. */
  choose() {
    if (!this.#open || this.#stale) return;
    this.#showSelected();
    this.#request();
  }

  async #load() {
    const trace = this.#trace;
    if (!this.#open || !trace || !this.#stale) return;
    this.#loading.abort();
    this.#loading = new AbortController();
    if (trace.live?.state === 'running') {
      const text = 'The run is still active. Its diagnostics are computed when it has ended.';
      return setPanelState(this.#host, 'empty', text);
    }
    try {
      const entries = await api.diagnostics(trace.selection, this.#loading.signal);
      this.#entries = inOrder(entries);
    } catch (error) {
      if (!isAbort(error)) setPanelState(this.#host, 'error', messageOf(error));
      return;
    }
    this.#stale = false;
    setPanelState(
      this.#host,
      this.#entries.length ? 'ready' : 'empty',
      'There are no diagnostics.',
    );
    this.#buildRows();
    this.#showSelected();
    this.#request();
  }

  /** Requests the selected diagnostic, or one after the other. */
  async #request() {
    this.#loading.abort();
    const { signal } = (this.#loading = new AbortController());
    const selected = this.#selected;
    for (const entry of selected ? [selected] : this.#entries) {
      if (!entry.why_not && this.#trace)
        await this.#results.load(this.#key(entry), this.#url(entry, this.#trace), signal);
      if (signal.aborted) return;
    }
  }

  /** @param {TraceDiagnosticInfo} entry */
  #computeOrCancel(entry) {
    if (this.#trace) this.#results.startOrCancel(this.#key(entry), this.#url(entry, this.#trace));
  }

  /**
   * @param {TraceDiagnosticInfo} entry
   * @param {Trace} trace
   */
  #url(entry, { selection }) {
    return api.diagnosticUrl(selection, entry.name, this.#query(entry));
  }

  /** @param {boolean} hasFinished whether jobs have finished, whose results are loaded */
  #update(hasFinished) {
    if (this.#stale) return;
    for (const entry of this.#entries) this.#draw(entry);
    if (hasFinished && this.#open) this.#request();
  }

  get #selected() {
    return this.#entries.find(({ name }) => name === this.#store.state.diagnostic);
  }

  /**
   * Returns the query of a request; only the selected diagnostic has options.
   * @param {TraceDiagnosticInfo} entry
   * @returns {Record<string, string>}
   */
  #query({ name }) {
    const { diagnostic, options, over } = this.#store.state;
    return {
      ...(name === diagnostic ? Object.fromEntries(new URLSearchParams(options)) : {}),
      ...(over === 'held-out' ? { episodes: 'held-out' } : {}),
    };
  }

  /** @param {TraceDiagnosticInfo} entry */
  #key(entry) {
    const { episode, ...names } = this.#trace?.selection ?? {};
    const isEpisode = this.#store.state.over === 'episode';
    return JSON.stringify([names, isEpisode && episode, entry.name, this.#query(entry)]);
  }

  /** Creates a row for each diagnostic; later only their contents change. */
  #buildRows() {
    for (const { name, title, question } of this.#entries) {
      if (this.#rows.has(name)) continue;
      const button = createButton('title', title, () => {
        this.#store.set({ diagnostic: name, options: '' });
        this.#store.flush();
        this.#backButton.focus();
      });
      const row = create(
        'li',
        {},
        button,
        create('p', { className: 'question', textContent: question }),
        create('p', { className: 'verdict' }),
        create('div', { className: 'doing' }),
      );
      this.#rows.set(name, row);
    }
    const rows = this.#entries.flatMap(({ name }) => this.#rows.get(name) ?? []);
    if (rows.some((row, i) => row !== this.#list.children[i])) this.#list.replaceChildren(...rows);
  }

  /** Shows the selected diagnostic, or the list of all. */
  #showSelected() {
    const { diagnostic, over, data } = this.#store.state;
    const runs = data.startsWith(LIVE_PREFIX) ? OVER_RUNS : OVER;
    const selected = this.#selected;
    const names = this.#entries.map(({ name }) => name).join(', ');
    html('.top h3', this.#host).textContent =
      diagnostic && !selected
        ? `The link names diagnostic “${diagnostic}”, which does not exist. Available: ${names}.`
        : (selected?.title ?? 'Diagnostics of this run');
    this.#list.hidden = Boolean(selected);
    this.#article.hidden = this.#backButton.hidden = !selected;
    choice(html('#over', this.#host), runs, over, (value) => this.#store.set({ over: value }));
    if (selected) {
      html('.question', this.#article).textContent = selected.question;
      this.#article.scrollTop = 0;
      this.#showOptions(selected);
    }
    for (const entry of this.#entries) this.#draw(entry);
  }

  /** @param {TraceDiagnosticInfo} entry */
  #showOptions({ name, options }) {
    const form = this.#form;
    const key = `${name} ${this.#store.state.options}`;
    if (form.dataset.key === key) return;
    const focused = focusedIn(form)?.getAttribute('name');
    form.dataset.key = key;
    form.hidden = !options.length;
    const values = new URLSearchParams(this.#store.state.options);
    const help = options.map((option) => `${option.name}: ${option.meaning}`).join('\n');
    form.replaceChildren(
      ...options.map((option) => this.#optionField(option, values.get(option.name) ?? '')),
      create('p', { textContent: help }),
    );
    if (focused) html(`[name="${focused}"]`, form).focus();
  }

  /**
   * @param {TraceDiagnosticInfo['options'][number]} option
   * @param {string} value
   */
  #optionField({ name, default: placeholder }, value) {
    const input = create('input', {
      name,
      placeholder,
      value,
      autocomplete: 'off',
      spellcheck: false,
    });
    const label = create('label', {}, name, input);
    if (name !== 'step') return label;
    const button = createButton('text quiet', 'current step', () => {
      input.value = String(this.#store.state.step);
      this.#setOptions();
    });
    label.append(button);
    return label;
  }

  #setOptions() {
    const options = new URLSearchParams();
    for (const [name, text] of new FormData(this.#form))
      if (String(text).trim()) options.set(name, String(text));
    this.#store.set({ options: String(options) });
  }

  /**
   * Draws the row of a diagnostic and, if it is selected, its article.
   * @param {TraceDiagnosticInfo} entry
   */
  #draw(entry) {
    /** @type {Result} */
    const result = entry.why_not
      ? { state: 'refused', error: entry.why_not }
      : this.#results.get(this.#key(entry));
    const row = this.#rows.get(entry.name);
    if (row) this.#drawState(row, entry, result);
    if (entry !== this.#selected) return;
    this.#drawState(this.#article, entry, result);
    this.#figures.show(result.state === 'ready' ? result.result : null, this.#trace);
  }

  /**
   * @param {HTMLElement} host
   * @param {TraceDiagnosticInfo} entry
   * @param {Result} result
   */
  #drawState(host, entry, result) {
    const verdict = html('.verdict', host);
    const { state } = result;
    const text = typeset(
      result.state === 'ready' ? result.result.verdict : resultText(result, STATES),
    );
    const { tone, status } = verdictStatus(state === 'ready' ? text : '');
    if (verdict.textContent !== text) {
      verdict.replaceChildren(create('b', { textContent: status }), text.slice(status.length));
      verdict.title = text;
    }
    host.dataset.state = state;
    if (tone) host.dataset.tone = tone;
    else delete host.dataset.tone;
    host.setAttribute('aria-busy', String(state === 'loading' || state === 'active'));
    const action = state === 'error' ? '' : jobAction(state, 'Compute');
    showJobButton(html('.doing', host), result, {
      action,
      label: `${action}: ${entry.title}`,
      progress: `Progress of ${entry.title}`,
      press: () => this.#computeOrCancel(entry),
      next: this.#backButton,
    });
  }
}

/**
 * Sorts diagnostics: fast ones, slow ones, which are computed on request, and inapplicable ones.
 * @template {{slow: boolean, why_not: string | null}} T
 * @param {T[]} entries
 */
export function inOrder(entries) {
  const rank = (/** @type {T} */ entry) => (entry.why_not ? 2 : Number(entry.slow));
  return [...entries].sort((a, b) => rank(a) - rank(b));
}

/**
 * Returns the comparison with the healthy record at the start of a verdict, and its tone; both empty without one.
 * @param {string} verdict
 */
export function verdictStatus(verdict) {
  const [status = ''] = /^(No alarm|Alarm|Unusual episode)/.exec(verdict) ?? [];
  const tones = { 'No alarm': 'good', Alarm: 'bad', 'Unusual episode': 'warn' };
  return { status, tone: tones[/** @type {keyof typeof tones} */ (status)] ?? '' };
}
