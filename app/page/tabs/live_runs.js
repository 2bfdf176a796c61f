/** Live runs: their list, and the updates of the page while one of them continues. */

/** @import { State, Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { Catalog, ListedLiveRun, LiveList } from '../types/server.js' */

import { LIVE_PREFIX } from '../core/constants.js';
import { create, element, html, pause } from '../core/dom.js';
import { filtersOf } from '../core/episodes.js';
import { parsePermalink } from '../core/state.js';
import { displayName, plural, sentence } from '../core/units.js';
import * as api from '../data/api.js';
import { liveStatus } from '../data/live_stream.js';

/** A run, or a damaged file that holds none. @typedef {LiveList['runs'][number]} ListedRun */
/** @typedef {{step: number, ms: number, at: number}} Latency from the write to the file until the step was drawn; at: time in ms */
/**
 * @typedef {object} LiveHandlers
 * @property {(trace: Trace, hasNewColumns: boolean) => void} grown called when a trace has more steps
 * @property {(trace: Trace) => void} ended called when the run of a trace has ended
 * @property {() => void} listed called when the list of runs has changed
 * @property {(message: string) => void} message shows a message, or removes it if empty
 * @property {(message: string) => void} deleted shows why the page has left a run
 */

const LIST_INTERVAL = 2000; // ms between two requests for the list
const MIN_INTERVAL = 50; // ms between two requests for steps
const MAX_LATENCIES = 1000;
const LIST_WIDTH = 388; // px, with its margin

/**
 * Replaces the live runs in the catalog; each is a data set of one episode.
 * @param {Catalog} catalog
 * @param {LiveList} list
 */
export function addLiveRuns(catalog, { runs, tasks }) {
  for (const task of catalog.tasks) {
    task.data = task.data.filter(({ live }) => !live);
    task.filters = task.filters.filter(({ live }) => !live);
  }
  for (const run of runs.filter(isReadable)) {
    const entry = catalog.tasks.find(({ name }) => name === run.task);
    const task = entry ?? tasks.find(({ name }) => name === run.task);
    if (!task) continue;
    if (!entry) catalog.tasks.push(task);
    const label = `${run.episode} · ${run.state === 'running' ? 'live' : 'recorded'}`;
    task.data.push({
      name: run.data,
      first: run.episode,
      first_step: 0,
      count: 1,
      live: run,
      episodes: [{ index: run.episode, steps: run.steps, label }],
    });
    if (!filtersOf(task, run.data).some(({ name }) => name === run.filter))
      task.filters.push({ name: run.filter, kind: run.kind, live: run.data });
  }
  const left = catalog.tasks.filter(({ data }) => data.length); // others had only deleted runs
  if (left.length) catalog.tasks = left;
}

/**
 * Returns the changes of the state that leave a run without a file: for the newest run of the task or of any other, or
 * else the first episode of a data set; null if the catalog has neither.
 * @param {Catalog} catalog
 * @param {ListedRun[]} runs
 * @param {State} state
 * @returns {Partial<State> | null}
 */
export function otherRun(catalog, runs, state) {
  const others = runs.filter(isReadable).filter(({ steps }) => steps);
  const run = others.find(({ task }) => task === state.task) ?? others[0];
  if (run) return liveRunState(catalog, run, state);
  if (!catalog.tasks[0]?.data.length) return null;
  const name = catalog.tasks.find((task) => task.name === state.task)?.name ?? '';
  const first = parsePermalink(name && `?${new URLSearchParams({ task: name })}`, catalog).state;
  const { task, filter, data, episode, step, component } = first;
  const reset = { faults: '', against: '', angle: null, window: '', playing: false, follow: false };
  return { task, filter, data, episode, step, component, ...reset };
}

/**
 * Returns the name of the live run of a link if it is not listed yet, otherwise ''. The page opens it when it starts.
 * @param {string} search query string
 * @param {LiveList} list
 */
export function awaitedRun(search, { runs }) {
  const data = new URLSearchParams(search).get('data') ?? '';
  const name = data.startsWith(LIVE_PREFIX) ? data.slice(LIVE_PREFIX.length) : '';
  return name && !runs.some((run) => run.name === name) ? name : '';
}

/**
 * Returns the changes of the state that select a live run at its newest step.
 * @param {Catalog} catalog
 * @param {ListedLiveRun} run
 * @param {State} current
 * @returns {Partial<State>}
 */
export function liveRunState(catalog, { task, filter, data, episode, steps, state }, current) {
  const map = catalog.tasks.find(({ name }) => name === task)?.map;
  const isRunning = state === 'running';
  return {
    task,
    filter,
    data,
    episode,
    faults: '',
    against: '',
    step: isRunning ? Math.max(0, steps - 1) : 0,
    angle: null,
    component: current.task === task || !map ? current.component : map.components[0],
    window: '',
    playing: false,
    follow: isRunning,
  };
}

export class Live {
  #button = element('#live', HTMLButtonElement);
  #list = html('#live-runs');
  #follow = html('#follow');
  #store;
  #handlers;
  /** @type {ListedRun[]} */
  #runs = [];
  /** Name of the run that the page opens when it starts. */
  #awaited;
  /** @type {Trace | null} */
  #trace = null;
  /** @type {Latency[]} */
  #latencies = [];

  /**
   * @param {Store} store
   * @param {LiveHandlers} handlers
   * @param {LiveList} list
   */
  constructor(store, handlers, list) {
    this.#store = store;
    this.#handlers = handlers;
    this.#awaited = awaitedRun(location.search, list);
    this.#follow.addEventListener('click', () => this.newest());
    this.#list.addEventListener('beforetoggle', (event) => {
      if (event.newState === 'open') this.#place();
    });
    store.listen((state, changed) => this.#update(state, changed));
    this.#setList(list);
    setInterval(() => document.hidden || this.#refreshList(), LIST_INTERVAL);
  }

  /** Latencies of the newest steps, for tests and measurements. */
  get latencies() {
    return this.#latencies;
  }

  /**
   * Follows the run of the displayed trace while it continues.
   * @param {Trace | null} trace
   */
  show(trace) {
    if (trace === this.#trace) return;
    this.#trace?.stream?.close();
    this.#trace = trace;
    this.#latencies = [];
    const awaited =
      this.#awaited && `The live run “${this.#awaited}” does not exist. It opens when it starts.`;
    this.#handlers.message(awaited || (trace?.live?.message ?? this.#selectedRun?.message ?? ''));
    if (this.#isRunning && this.#store.state.follow) this.#goToNewest();
    this.#showFollowButton();
    if (trace && this.#isRunning) this.#receive(trace);
  }

  /** Follows the newest step of the current run, or opens the newest active run, or the list of runs. */
  newest() {
    const run = this.#runs.filter(isReadable).find(({ state }) => state === 'running');
    if (this.#isRunning) this.#store.set({ follow: true });
    else if (run) this.#open(run);
    else if (this.#runs.length) this.#list.togglePopover();
  }

  get #isRunning() {
    return this.#trace?.live?.state === 'running';
  }

  get #selectedRun() {
    return this.#runs.filter(isReadable).find(({ data }) => data === this.#store.state.data);
  }

  /**
   * @param {State} state
   * @param {Set<string>} changed
   */
  #update({ data, step, playing, follow }, changed) {
    if (['task', 'filter', 'data', 'episode'].some((key) => changed.has(key))) this.#awaited = '';
    const trace = this.#trace;
    if (!trace || !this.#isRunning || data !== trace.selection.data || changed.has('data')) return;
    // Moving the cursor away from the newest step stops following, moving it there resumes.
    if (changed.has('step') && this.#store.origin !== 'live')
      this.#store.set({ follow: step >= trace.steps - 1 });
    else if (changed.has('playing') && playing) this.#store.set({ follow: false });
    else if (changed.has('follow') && follow) this.#goToNewest();
    this.#showFollowButton();
  }

  #goToNewest() {
    const step = (this.#trace?.steps ?? 1) - 1;
    this.#store.set({ step, playing: false }, { origin: 'live' });
  }

  /**
   * Receives the steps of a live run. The next block is requested when the last one is drawn, so that a slow or hidden
   * page receives larger blocks instead of a queue.
   * @param {Trace} trace
   */
  async #receive(trace) {
    const { stream } = trace;
    if (!stream || !trace.live) return;
    while (this.#trace === trace && this.#isRunning) {
      const start = performance.now();
      const block = await stream.next(trace.steps, trace.live.state);
      if (!block || this.#trace !== trace) break;
      trace.live = { ...trace.live, ...liveStatus(block) };
      if (block.steps) {
        const hasNewColumns = trace.grow(block);
        this.#handlers.grown(trace, hasNewColumns);
        if (this.#store.state.follow) this.#goToNewest();
        this.#showFollowButton();
      }
      await nextPaint();
      if (block.steps) this.#addLatency(trace.steps - 1, block.written);
      if (trace.steps >= block.total) await pause(start + MIN_INTERVAL - performance.now());
    }
    stream.close();
    if (this.#trace !== trace) return;
    if (stream.error) {
      const message = `The live run cannot be read: ${stream.error}.`;
      trace.live = { ...trace.live, state: 'gone', message };
    }
    this.#showFollowButton();
    this.#handlers.message(trace.live.message);
    this.#handlers.ended(trace);
    this.#refreshList();
  }

  /**
   * @param {number} step
   * @param {number} written time in s
   */
  #addLatency(step, written) {
    const now = Date.now();
    this.#latencies.push({ step, ms: now - 1000 * written, at: now });
    this.#latencies.splice(0, this.#latencies.length - MAX_LATENCIES);
  }

  #showFollowButton() {
    const { follow, step } = this.#store.state;
    this.#follow.hidden = !this.#isRunning;
    if (!this.#trace || !this.#isRunning) return;
    const behind = this.#trace.steps - 1 - step;
    this.#follow.setAttribute('aria-pressed', String(Boolean(follow)));
    if (this.#follow.lastChild)
      this.#follow.lastChild.textContent = follow || !behind ? 'Live' : `${behind} behind`;
  }

  async #refreshList() {
    const list = await api.liveRuns().catch(() => null);
    const run = this.#selectedRun;
    const isListed = list?.runs.some((other) => isReadable(other) && other.data === run?.data);
    const reason = list && run && !isListed ? await this.#refusal() : '';
    if (!list || run !== this.#selectedRun) return; // another run or list since then
    if (run && !isListed && !reason) list.runs.push(run); // older than the listed ones
    this.#setList(list);
    if (run && reason) this.#leave(run, reason);
  }

  /** Returns why the server cannot display the selected run; empty if it can. */
  #refusal() {
    const isRefused = (/** @type {unknown} */ error) =>
      error instanceof api.ServerError && error.isRefusal ? error.message : '';
    return api.checkSelection({ ...this.#store.state, against: '' }).then(() => '', isRefused);
  }

  /**
   * Displays another run in place of one whose file was deleted or damaged.
   * @param {ListedLiveRun} run
   * @param {string} reason
   */
  #leave({ name }, reason) {
    const { catalog, state } = this.#store;
    const isDamaged = this.#runs.some((run) => run.name === name);
    const next = otherRun(catalog, this.#runs, state);
    const shown = next ? `The page now shows ${next.data}.` : 'There is no other run to display.';
    const advice = isDamaged
      ? ''
      : 'Its file was deleted or moved; restore it to display the run. ';
    this.#handlers.deleted(`${sentence(reason)} ${advice}${shown}`);
    if (next) this.#store.set(next);
  }

  /** @param {LiveList} list */
  #setList(list) {
    const isNew = fingerprint(list.runs) !== fingerprint(this.#runs);
    this.#runs = list.runs;
    if (isNew) {
      addLiveRuns(this.#store.catalog, list);
      this.#handlers.listed();
    }
    const running = this.#runs.filter(({ state }) => state === 'running').length;
    const summary = running
      ? `${running} active live ${running > 1 ? 'runs' : 'run'}`
      : 'Live runs, all ended';
    this.#button.hidden = !this.#runs.length;
    this.#button.classList.toggle('on', running > 0);
    this.#button.title = `${summary} (l)`;
    this.#draw();
    const awaited = this.#runs.filter(isReadable).find(({ name }) => name === this.#awaited);
    if (awaited) this.#open(awaited);
  }

  /** Shows the runs, the newest first. Rows are reused, so that the focus stays. */
  #draw() {
    const host = html('ol', this.#list);
    while (host.children.length > this.#runs.length) host.lastChild?.remove();
    while (host.children.length < this.#runs.length) host.append(create('li', { innerHTML: ROW }));
    this.#runs.forEach((run, i) => {
      const line = host.children[i];
      const button = element('button', HTMLButtonElement, line);
      if (line instanceof HTMLElement) line.dataset.state = run.state;
      const isCurrent = isReadable(run) && run.data === this.#store.state.data;
      button.disabled = !isReadable(run);
      button.setAttribute('aria-current', String(isCurrent));
      const name = html('b', button);
      name.textContent = name.title = run.name;
      const owner = html('span', button);
      owner.textContent = owner.title = isReadable(run)
        ? `${run.filter} · ${displayName(run.task)} ${run.episode}`
        : '';
      const status = html('small', button);
      status.textContent = status.title = statusLine(run);
      button.onclick = () => isReadable(run) && this.#open(run);
    });
  }

  /** @param {ListedLiveRun} run */
  #open(run) {
    this.#list.hidePopover();
    const { state } = this.#store;
    if (run.data === state.data && this.#isRunning) this.#store.set({ follow: true });
    else this.#store.set(liveRunState(this.#store.catalog, run, state));
  }

  #place() {
    const { left, bottom } = this.#button.getBoundingClientRect();
    this.#list.style.left = `${Math.max(8, Math.min(left, innerWidth - LIST_WIDTH))}px`;
    this.#list.style.top = `${bottom + 5}px`;
    this.#draw();
  }
}

const ROW = '<button type="button"><b></b><span></span><small></small></button>';

/**
 * Returns what the pickers depend on.
 * @param {ListedRun[]} runs
 */
const fingerprint = (runs) =>
  JSON.stringify(
    runs.map((run) => [run.name, run.state, ...(isReadable(run) ? [run.started, run.filter] : [])]),
  );

/**
 * @param {ListedRun} run
 * @returns {run is ListedLiveRun}
 */
function isReadable(run) {
  return 'data' in run;
}

/** @param {ListedRun} run */
function statusLine(run) {
  if (run.message || !isReadable(run)) return run.message;
  const { state, steps, expected, available } = run;
  const count = expected ? `${steps} of ${plural(expected, 'step')}` : plural(steps, 'step');
  const missing = available ? '' : ' · checkpoint not on this server (--filter)';
  return `${state === 'running' ? 'running' : 'ended'}, ${count}${missing}`;
}

/** Resolves after the next paint; waits while the page is hidden. */
const nextPaint = () => new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve)));
