/** Live runs: which there are, and how the page fills while one of them goes on. */

import * as api from '../data/api.js';
import { liveStatus } from '../data/live_stream.js';
import { displayName } from '../core/units.js';

const AGAIN = 2000; // ms until it is asked again which there are
const SOONEST = 50; // ms from one question for more steps to the next
const KEPT = 1000; // latencies

/** @typedef {{name: string, data: string, task: string, filter: string, available: boolean, episode: number, steps: number, expected: number | null, state: string, message: string}} Run */

/** Puts runs into the catalog, each as a data set of one episode, in place of those before. @param {import('../data/api.js').Catalog} catalog */
export function addLiveRuns(catalog, { runs, tasks }) {
  for (const task of catalog.tasks) {
    task.data = task.data.filter(({ live }) => !live);
    task.filters = task.filters.filter(({ live }) => !live);
  }
  for (const run of runs.filter(({ data }) => data)) {
    let task = catalog.tasks.find(({ name }) => name === run.task);
    if (!task) catalog.tasks.push((task = tasks.find(({ name }) => name === run.task)));
    const label = [run.episode, run.state === 'running' ? 'live' : 'live, ended'].join(' · ');
    task.data.push({
      name: run.data,
      first: run.episode,
      live: run,
      episodes: [{ index: run.episode, steps: run.steps, label }],
    });
    if (!task.filters.some(({ name }) => name === run.filter))
      task.filters.push({ name: run.filter, kind: run.kind, live: run.data });
  }
}

/** What the state must become to show a run at its newest step. @param {import('../data/api.js').Catalog} catalog @param {Run} run */
export function liveRunState(catalog, { task: name, filter, data, episode, steps, state }, now) {
  const { map } = catalog.tasks.find((task) => task.name === name);
  const component = now.task === name ? now.component : map.x;
  const running = state === 'running';
  return {
    task: name,
    filter,
    data,
    episode,
    faults: '',
    against: '',
    step: running ? Math.max(0, steps - 1) : 0,
    angle: null,
    component,
    window: '',
    playing: false,
    follow: running,
  };
}

export class Live {
  #button;
  #list;
  #follow;
  #catalog;
  #store;
  #handlers;
  #runs = [];
  #trace = null;
  #latencies = [];

  /**
   * @param {HTMLElement} root of the page @param {import('../data/api.js').Catalog} catalog @param {import('../core/state.js').Store} store
   * @param {{grown: (trace: import('../data/trace.js').Trace, fresh: boolean) => void, ended: (trace: import('../data/trace.js').Trace) => void, listed: () => void, say: (line: string) => void}} handlers
   *   are told that a trace has more steps (fresh: and columns), that its run has ended, that there are other runs, what is to be said
   * @param {import('../data/api.js').LiveList} first
   */
  constructor(root, catalog, store, handlers, first) {
    [this.#button, this.#list, this.#follow] = ['#live', '#live-runs', '#follow'].map((part) =>
      root.querySelector(part),
    );
    [this.#catalog, this.#store, this.#handlers] = [catalog, store, handlers];
    this.#follow.addEventListener('click', () => this.newest());
    this.#list.addEventListener(
      'beforetoggle',
      ({ newState }) => newState === 'open' && this.#place(),
    );
    store.listen((state, changed) => this.#heed(state, changed));
    this.#take(first);
    setInterval(() => document.hidden || this.#look(), AGAIN);
  }

  /** Latencies of the newest steps, ms from the file's write until they were drawn: for tests and measurements. */
  get latencies() {
    return this.#latencies;
  }

  /** Another trace is shown; one whose run goes on is filled. @param {import('../data/trace.js').Trace | null} trace */
  show(trace) {
    if (trace === this.#trace) return;
    this.#trace?.stream?.close();
    this.#trace = trace;
    this.#latencies = [];
    const { live } = trace ?? {};
    this.#handlers.say(live?.message ?? this.#shown?.message ?? '');
    if (this.#running && this.#store.state.follow) this.#go();
    this.#tell();
    if (this.#running) this.#fill(trace);
  }

  /** Goes to the newest step and stays there; without a run that goes on, to the newest such, or shows which there are. */
  newest() {
    const run = this.#runs.find(({ state }) => state === 'running');
    if (this.#running) this.#store.set({ follow: true });
    else if (run) this.#open(run);
    else if (this.#runs.length) this.#list.togglePopover();
  }

  get #running() {
    return this.#trace?.live?.state === 'running';
  }

  /** The shown run as the list has it. */
  get #shown() {
    return this.#runs.find(({ data }) => data === this.#store.state.data);
  }

  #heed({ data, step, playing, follow }, changed) {
    if (!this.#running || data !== this.#trace.selection.data || changed.has('data')) return;
    // Who moves the cursor away leaves the newest step, who moves it there comes back to it.
    if (changed.has('step') && this.#store.origin !== 'live')
      this.#store.set({ follow: step >= this.#trace.steps - 1 });
    else if (changed.has('playing') && playing) this.#store.set({ follow: false });
    else if (changed.has('follow') && follow) this.#go();
    this.#tell();
  }

  #go() {
    this.#store.set({ step: this.#trace.steps - 1, playing: false }, { origin: 'live' });
  }

  /** Asks for more once what has come is drawn: a page that is slow, or out of sight, gets larger blocks, and none wait. */
  async #fill(trace) {
    while (this.#trace === trace && this.#running) {
      const asked = performance.now();
      const block = await trace.stream.next(trace.steps, trace.live.state);
      if (!block || this.#trace !== trace) break;
      trace.live = { ...trace.live, ...liveStatus(block) };
      if (block.steps) {
        const fresh = trace.grow(block);
        this.#handlers.grown(trace, fresh);
        if (this.#store.state.follow) this.#go();
        this.#tell();
      }
      await drawn();
      if (block.steps)
        this.#latencies = [
          ...this.#latencies,
          { step: trace.steps - 1, ms: Date.now() - 1000 * block.written, at: Date.now() },
        ].slice(-KEPT);
      const behind = trace.steps < block.total;
      if (!behind)
        await new Promise((resolve) =>
          setTimeout(resolve, Math.max(0, asked + SOONEST - performance.now())),
        );
    }
    trace.stream.close();
    if (this.#trace !== trace) return;
    if (trace.stream.error)
      trace.live = {
        ...trace.live,
        state: 'gone',
        message: `The live run has gone: ${trace.stream.error}.`,
      };
    this.#tell();
    this.#handlers.say(trace.live.message);
    this.#handlers.ended(trace);
    this.#look();
  }

  /** The button that leads to the newest step. */
  #tell() {
    const { follow, step } = this.#store.state;
    this.#follow.hidden = !this.#running;
    if (!this.#running) return;
    const behind = this.#trace.steps - 1 - step;
    this.#follow.setAttribute('aria-pressed', String(Boolean(follow)));
    this.#follow.lastChild.textContent = follow || !behind ? 'Live' : `${behind} behind`;
  }

  async #look() {
    const found = await api.liveRuns().catch(() => null);
    if (found) this.#take(found);
  }

  #take(found) {
    const others = identity(found.runs) !== identity(this.#runs);
    this.#runs = found.runs;
    if (others) {
      addLiveRuns(this.#catalog, found);
      this.#handlers.listed();
    }
    const running = this.#runs.filter(({ state }) => state === 'running').length;
    this.#button.hidden = !this.#runs.length;
    this.#button.classList.toggle('on', running > 0);
    this.#button.title = `${running ? `${running} live ${running > 1 ? 'runs go' : 'run goes'} on` : 'Live runs, all ended'} (l)`;
    this.#draw();
  }

  /** A row for each run, the newest first; rows stay, so that the focus does. */
  #draw() {
    const host = this.#list.querySelector('ol');
    while (host.children.length > this.#runs.length) host.lastChild.remove();
    this.#runs.forEach((run, i) => {
      const row = host.children[i] ?? host.appendChild(this.#row());
      const [name, what, how] = row.firstChild.children;
      row.dataset.state = run.state;
      row.firstChild.disabled = !run.data;
      row.firstChild.setAttribute('aria-current', String(run.data === this.#store.state.data));
      [name.textContent, what.textContent] = [
        run.name,
        run.data ? `${run.filter} · ${displayName(run.task)} ${run.episode}` : '',
      ];
      how.textContent = how.title = said(run);
      row.firstChild.onclick = () => this.#open(run);
    });
  }

  #row() {
    const row = document.createElement('li');
    row.innerHTML = '<button type="button"><b></b><span></span><small></small></button>';
    return row;
  }

  #open(run) {
    this.#list.hidePopover();
    const { state } = this.#store;
    if (run.data === state.data && this.#running) this.#store.set({ follow: true });
    else this.#store.set(liveRunState(this.#catalog, run, state));
  }

  #place() {
    const { left, bottom } = this.#button.getBoundingClientRect();
    Object.assign(this.#list.style, {
      left: `${Math.max(8, Math.min(left, innerWidth - 388))}px`,
      top: `${bottom + 5}px`,
    });
    this.#draw();
  }
}

/** What the pickers depend on. */
const identity = (runs) =>
  JSON.stringify(runs.map(({ name, state, started, filter }) => [name, state, started, filter]));

/** How a run is, in a line. @param {Run} run */
function said({ state, message: line, steps, expected, available }) {
  if (line) return line;
  const count = expected ? `${steps} of ${expected} steps` : `${steps} steps`;
  const absent = available ? '' : ' · its checkpoint is not served here (--filter)';
  return `${state === 'running' ? 'goes on' : 'ended'}, ${count}${absent}`;
}

/** When the browser has drawn; a page out of sight waits here. */
const drawn = () => new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve)));
