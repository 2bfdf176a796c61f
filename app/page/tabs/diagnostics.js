/** The diagnostics of what is shown: all of them with what they say, or one with its figures; slow ones as jobs. */

import * as api from '../data/api.js';
import { Figures } from '../widgets/figures.js';
import { pending, jobSummary, isActive } from '../widgets/jobs.js';
import { setPanelState } from '../widgets/panel_state.js';
import { choice } from '../widgets/pickers.js';
import { sentence } from '../core/units.js';

const OVER = [
  ['episode', 'this episode'],
  ['held-out', 'all held-out'],
];
const KEPT = 48; // results

/**
 * @typedef {object} Result what is known of one diagnostic, with one choice of options, of one trace or of all held out
 * @property {'loading' | 'ready' | 'absent' | 'active' | 'ended' | 'error'} state
 * @property {api.DiagnosticResult} [found] @property {api.Job} [job] @property {string} [error]
 */

export class Diagnostics {
  #host;
  #store;
  #jobs;
  #figures;
  #trace = null;
  #entries = null;
  #rows = new Map();
  /** @type {Map<string, Result>} */
  #results = new Map();
  #loading = new AbortController();
  #open = false;
  #stale = true; // whether what is shown is of another trace

  /** @param {HTMLElement} host @param {import('../core/state.js').Store} store @param {import('../widgets/jobs.js').Jobs} jobs */
  constructor(host, store, jobs) {
    [this.#host, this.#store, this.#jobs] = [host, store, jobs];
    this.#figures = new Figures(host.querySelector('.figures'), store);
    host.querySelector('#all-diagnostics').addEventListener('click', () => {
      const { diagnostic } = store.state;
      store.set({ diagnostic: '', options: '' });
      store.flush();
      this.#rows.get(diagnostic)?.querySelector('.title').focus();
    });
    host
      .querySelector('form')
      .addEventListener('submit', (event) => (event.preventDefault(), this.#takeOptions()));
    host.querySelector('form').addEventListener('change', () => this.#takeOptions());
    jobs.listen((list) => this.#hear(list));
    setPanelState(host, 'loading', 'Loading …');
  }

  /** Whether the panel can be seen: nothing is asked for before. */
  set open(open) {
    this.#open = open;
    if (open) this.#load();
  }

  /** @param {import('../data/trace.js').Trace} trace */
  show(trace) {
    [this.#trace, this.#stale] = [trace, true];
    this.#load();
  }

  move(step) {
    if (this.#open && this.#store.state.diagnostic) this.#figures.move(step);
  }

  redraw() {
    this.#figures.redraw();
  }

  /** Another diagnostic was opened, or what they are made over was changed. */
  choose() {
    if (!this.#entries || !this.#open || this.#stale) return;
    this.#showOpen();
    this.#ask();
  }

  async #load() {
    if (!this.#open || !this.#trace || !this.#stale) return;
    this.#loading.abort();
    this.#loading = new AbortController();
    const trace = this.#trace;
    if (trace.live?.state === 'running')
      return setPanelState(
        this.#host,
        'empty',
        'The run goes on. Diagnostics are made of all its steps once it has ended, and show here by themselves.',
      );
    try {
      this.#entries = await api.diagnostics(trace.selection, this.#loading.signal);
    } catch (error) {
      if (error.name !== 'AbortError') setPanelState(this.#host, 'error', error.message);
      return;
    }
    this.#stale = false;
    setPanelState(this.#host, this.#entries.length ? 'ready' : 'empty', 'There are no diagnostics.');
    this.#build();
    this.#showOpen();
    this.#ask();
  }

  /** Asks for what is seen: the open one, or each in turn. */
  async #ask() {
    this.#loading.abort();
    const { signal } = (this.#loading = new AbortController());
    const open = this.#opened;
    for (const entry of open ? [open] : this.#entries) {
      if (!entry.why_not) await this.#askFor(entry, signal);
      if (signal.aborted) return;
    }
  }

  async #askFor(entry, signal) {
    const key = this.#key(entry);
    if (this.#results.get(key)?.state === 'ready') return this.#draw(entry);
    if (!this.#results.has(key)) this.#keep(key, { state: 'loading' });
    this.#draw(entry);
    try {
      const body = await api.diagnostic(
        this.#trace.selection,
        entry.name,
        this.#query(entry),
        signal,
      );
      this.#keep(key, pending(body));
    } catch (error) {
      if (error.name === 'AbortError') return;
      this.#keep(key, { state: 'error', error: error.message });
    }
    this.#draw(entry);
  }

  async #compute(entry) {
    const key = this.#key(entry);
    try {
      this.#keep(
        key,
        pending(await api.startDiagnostic(this.#trace.selection, entry.name, this.#query(entry))),
      );
    } catch (error) {
      this.#keep(key, { state: 'error', error: error.message });
    }
    this.#draw(entry);
    this.#jobs.refresh();
  }

  /** Jobs have changed: those that are shown are drawn again, and what is done is fetched. */
  #hear(list) {
    if (!this.#entries || this.#stale) return;
    const byId = new Map(list.map((job) => [job.id, job]));
    let done = false;
    for (const [key, { job }] of [...this.#results]) {
      if (!job) continue;
      const now = byId.get(job.id);
      if (now?.state === 'done') [done] = [true, this.#results.delete(key)];
      else this.#keep(key, pending({ job: now ?? null }));
    }
    for (const entry of this.#entries) this.#draw(entry);
    if (done && this.#open) this.#ask();
  }

  #keep(key, kept) {
    this.#results.delete(key);
    this.#results.set(key, kept);
    if (this.#results.size > KEPT) this.#results.delete(this.#results.keys().next().value);
  }

  get #opened() {
    return this.#entries.find(({ name }) => name === this.#store.state.diagnostic);
  }

  /** What is asked for beside the trace; only the open one has options. */
  #query({ name }) {
    const { diagnostic, options, over } = this.#store.state;
    return {
      ...(name === diagnostic ? Object.fromEntries(new URLSearchParams(options)) : {}),
      ...(over === 'held-out' ? { episodes: 'held-out' } : {}),
    };
  }

  #key(entry) {
    const { episode, ...selection } = this.#trace.selection;
    const { over } = this.#store.state;
    return JSON.stringify([
      selection,
      over === 'episode' && episode,
      entry.name,
      this.#query(entry),
    ]);
  }

  /** A row for each, made once; what is in it changes. */
  #build() {
    if (this.#rows.size) return;
    for (const entry of this.#entries) {
      const row = document.createElement('li');
      row.innerHTML =
        '<button type="button" class="title"></button><p class="question"></p><p class="verdict"></p><div class="doing"></div>';
      row.querySelector('.title').textContent = entry.title;
      row.querySelector('.question').textContent = entry.question;
      row.querySelector('.title').addEventListener('click', () => {
        this.#store.set({ diagnostic: entry.name, options: '' });
        this.#store.flush();
        this.#host.querySelector('#all-diagnostics').focus();
      });
      this.#rows.set(entry.name, row);
    }
    this.#host.querySelector('.list').replaceChildren(...this.#rows.values());
  }

  /** The list of all, or the one that is open. */
  #showOpen() {
    const { state } = this.#store;
    const open = this.#opened;
    if (state.diagnostic && !open) {
      const names = this.#entries.map(({ name }) => name).join(', ');
      const line = `The link asks for diagnostic “${state.diagnostic}”, which does not exist. Available: ${names}.`;
      this.#host.querySelector('.top h3').textContent = line;
    } else {
      this.#host.querySelector('.top h3').textContent = open
        ? open.title
        : 'Diagnostics of this run';
    }
    this.#host.querySelector('.list').hidden = Boolean(open);
    this.#host.querySelector('article').hidden = !open;
    this.#host.querySelector('#all-diagnostics').hidden = !open;
    choice(this.#host.querySelector('#over'), OVER, state.over, (over) =>
      this.#store.set({ over }),
    );
    if (open) {
      this.#host.querySelector('article .question').textContent = open.question;
      this.#host.querySelector('article').scrollTop = 0;
      this.#showOptions(open);
    }
    for (const entry of this.#entries) this.#draw(entry);
  }

  #showOptions(entry) {
    const form = this.#host.querySelector('form');
    const asked = `${entry.name} ${this.#store.state.options}`;
    if (form.dataset.of === asked) return;
    const focused = form.contains(document.activeElement) && document.activeElement.name;
    form.dataset.of = asked;
    form.hidden = !entry.options.length;
    const chosen = new URLSearchParams(this.#store.state.options);
    form.replaceChildren(
      ...entry.options.map(({ name, default: usual }) => {
        const label = document.createElement('label');
        const input = document.createElement('input');
        Object.assign(input, {
          name,
          placeholder: usual,
          value: chosen.get(name) ?? '',
          autocomplete: 'off',
          spellcheck: false,
        });
        label.textContent = name;
        label.append(input);
        if (name !== 'step') return label;
        const here = document.createElement('button');
        [here.type, here.className, here.textContent] = ['button', 'text quiet', 'at the cursor'];
        here.addEventListener(
          'click',
          () => ((input.value = String(this.#store.state.step)), this.#takeOptions()),
        );
        label.append(here);
        return label;
      }),
      Object.assign(document.createElement('p'), {
        textContent: entry.options.map(({ name, meaning }) => `${name}: ${meaning}`).join('\n'),
      }),
    );
    if (focused) form.elements[focused]?.focus();
  }

  #takeOptions() {
    const given = [...new FormData(this.#host.querySelector('form'))].filter(([, text]) =>
      text.trim(),
    );
    this.#store.set({ options: String(new URLSearchParams(given)) });
  }

  /** Writes what is known of one into its row and, if it is open, into the page. */
  #draw(entry) {
    const known = entry.why_not
      ? { state: 'refused', error: entry.why_not }
      : (this.#results.get(this.#key(entry)) ?? { state: 'loading' });
    this.#tell(this.#rows.get(entry.name), entry, known);
    if (entry !== this.#opened) return;
    const article = this.#host.querySelector('article');
    this.#tell(article, entry, known);
    this.#figures.show(known.result ?? null, this.#trace);
  }

  #tell(host, entry, known) {
    const [verdict, doing] = [host.querySelector('.verdict'), host.querySelector('.doing')];
    const text = said(entry, known);
    if (verdict.textContent !== text) verdict.textContent = verdict.title = text;
    const before = host.dataset.state;
    host.dataset.state = known.state;
    host.setAttribute('aria-busy', String(known.state === 'loading' || known.state === 'active'));
    const acts = { unasked: 'Compute', ended: 'Try again', working: 'Cancel' }[known.state];
    if (before !== known.state || (acts && !doing.firstChild)) {
      const focused = doing.contains(document.activeElement);
      doing.replaceChildren(...(acts ? [this.#button(acts, entry)] : []));
      if (known.state === 'active') doing.prepend(document.createElement('progress'));
      if (focused)
        (
          doing.querySelector('button') ??
          host.querySelector('.title') ??
          this.#host.querySelector('#all-diagnostics')
        ).focus();
    }
    const progress = doing.querySelector('progress');
    if (!progress) return;
    progress.setAttribute('aria-label', `Progress of ${entry.title}`);
    progress.value = known.job.progress;
  }

  #button(name, entry) {
    const button = document.createElement('button');
    [button.type, button.className, button.textContent] = ['button', 'text', name];
    button.setAttribute('aria-label', `${name}: ${entry.title}`);
    button.addEventListener('click', () => {
      const { job } = this.#results.get(this.#key(entry)) ?? {};
      if (job && isActive(job)) this.#jobs.cancel(job.id);
      else this.#compute(entry);
    });
    return button;
  }
}

function said(entry, { state, found, job, error }) {
  if (state === 'ready') return found.verdict;
  if (state === 'refused' || state === 'error') return sentence(error);
  if (state === 'active' || state === 'ended') return jobSummary(job);
  if (state === 'absent') return 'Takes a while, so it is computed only when asked for.';
  return 'Measuring …';
}
