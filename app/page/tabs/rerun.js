/**
 * Rerun's viewer, loaded when its tab is first opened. It shows the recording of the current run, whose time follows the
 * page's step and the reverse; or files instead, with their own time unless the only file is of the current run.
 */

/** @import { WebViewer } from '/vendor/rerun/viewer.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { RecordingEntry } from '../types/server.js' */
/** @import { Store } from '../core/state.js' */
/** @import { Jobs } from '../widgets/jobs.js' */
/** @import { Run } from './recorded_run.js' */

import { create, createButton, html, messageOf, pause } from '../core/dom.js';
import { recordingRequest } from '../data/api.js';
import { setPanelState } from '../widgets/panel_state.js';
import { writeRecording } from '../widgets/save_button.js';
import { describeOpened, isSameRun } from './recorded_run.js';

/** @typedef {{url: string}} RecordingUrl */
/**
 * A file of the workspace, and its run if this server has it.
 * @typedef {RecordingEntry & {isOf: Run | null}} RecordingFile
 */

const SETTLE_FRAMES = 30; // at most, until a recording that is being opened keeps our time
const STABLE_FRAMES = 3; // with our time, after which it is kept
const ECHO_FRAMES = 4; // until the viewer reports a time that we have set

export class Rerun {
  #host;
  #store;
  #jobs;
  /** @type {WebViewer | null} */
  #viewer = null;
  /** @type {Promise<WebViewer> | null} */
  #starting = null;
  /** What the viewer displays. @type {Trace | RecordingFile[] | null} */
  #source = null;
  /** @type {Trace | null} */
  #trace = null;
  /** Files to display in place of the trace. @type {RecordingFile[] | null} */
  #files = null;
  #problem = '';
  /** The source, once it keeps our time. @type {Trace | RecordingFile[] | null} */
  #settled = null;
  /** IDs of the stores that we have opened. @type {string[]} */
  #stores = [];
  #fileName = document.createElement('span');
  #bar = create('p', { className: 'files', hidden: true }, this.#fileName);
  #close = createButton('text', 'Close the recording', () => this.#store.set({ recording: '' }));
  #step = 0;
  /** Step to be set next. @type {number | null} */
  #pending = null;
  #busy = false;
  /** Step that was set last, until the viewer reports it. @type {number | null} */
  #echo = null;
  #open = false;

  /**
   * @param {HTMLElement} host
   * @param {Store} store
   * @param {Jobs} jobs
   */
  constructor(host, store, jobs) {
    this.#host = host;
    this.#store = store;
    this.#jobs = jobs;
    this.#bar.append(this.#close);
    host.append(this.#bar);
    store.when(['task', 'filter', 'data', 'episode', 'faults'], () => this.#showBar());
  }

  /** @param {Trace} trace */
  show(trace) {
    this.#trace = trace;
    this.#load();
  }

  /**
   * Displays files; null for the current run.
   * @param {RecordingFile[] | null} files
   * @param {string} [problem] why files cannot be displayed
   */
  files(files, problem = '') {
    this.#files = files;
    this.#problem = problem;
    this.#showBar();
    this.#load();
  }

  /** Whether the page shows the run of the only file. */
  get #isFileOfRun() {
    const run = this.#files?.length === 1 ? this.#files[0].isOf : null;
    return Boolean(run && isSameRun(run, this.#store.state));
  }

  #showBar() {
    const files = this.#files;
    const isOfRun = this.#isFileOfRun;
    this.#bar.hidden = !files && !this.#problem;
    this.#bar.classList.toggle('other-run', !isOfRun);
    this.#close.textContent = isOfRun ? 'Close the recording' : 'Back to the current run';
    const text = files ? describeOpened(files, isOfRun, this.#store.state) : this.#problem;
    this.#fileName.textContent = text;
    this.#fileName.title = [text, ...(files ?? []).map((file) => file.why_not)]
      .filter(Boolean)
      .join('\n');
  }

  /** Whether the tab is selected. */
  set open(/** @type {boolean} */ open) {
    this.#open = open;
    this.#load();
  }

  /**
   * @param {number} step
   * @param {boolean} fromRerun whether the step was changed in the viewer
   */
  move(step, fromRerun) {
    this.#step = step;
    if (!fromRerun) this.#seek(step);
  }

  /** Returns the state of the viewer, for tests. */
  async getState() {
    return this.#viewer ? this.#viewer.get_state() : null;
  }

  async #load() {
    const source = this.#files ?? this.#trace;
    if (!this.#open || !source) return;
    if (this.#source === source) {
      this.#seek(this.#step);
      return;
    }
    this.#source = source;
    this.#settled = null;
    try {
      await this.#display(source);
    } catch (error) {
      if (this.#source !== source) return;
      this.#source = null;
      // A read-only server cannot write the recording of a run: that is no failure.
      const isExpected = source === this.#trace && !html('#read-only').hidden;
      const text = messageOf(error);
      setPanelState(
        this.#host,
        isExpected ? 'empty' : 'error',
        isExpected ? text : `Rerun cannot display this: ${text}`,
      );
    }
  }

  /** @param {Trace | RecordingFile[]} source */
  async #display(source) {
    const isTrace = !Array.isArray(source);
    const sharesTime = isTrace || this.#isFileOfRun;
    setPanelState(this.#host, 'loading', isTrace ? 'Writing the recording …' : 'Starting Rerun …');
    const [recordings, viewer] = await Promise.all([
      isTrace ? Promise.all([this.#recordingOf(source)]) : source,
      this.#start(),
    ]);
    if (this.#source !== source) return;
    setPanelState(this.#host, 'loading', 'Opening the recording …');
    const urls = recordings.map(({ url }) => new URL(url, location.href).href);
    const { store_ids: stores } = await viewer.open(urls);
    const others = this.#stores.filter((id) => !stores.includes(id));
    this.#stores = [...others, ...stores];
    if (this.#source !== source) return;
    viewer.override_panel_state('blueprint', recordings.length > 1 ? 'expanded' : undefined);
    setPanelState(this.#host, 'ready');
    // Each of the following requests takes one drawing or more; the recording is already visible.
    if (sharesTime) await this.#settle(viewer, source);
    if (this.#source !== source) return;
    this.#stores = stores;
    await Promise.allSettled(others.map((id) => viewer.close({ store_ids: [id] })));
    this.#seek(this.#step);
  }

  /**
   * Returns the recording of a trace. A live run writes it as it grows; that of any other run is written now.
   * @param {Trace} trace
   * @returns {Promise<RecordingUrl>}
   */
  async #recordingOf(trace) {
    if (trace.stream && trace.live) {
      const url = `/api/live/${encodeURIComponent(trace.live.name)}.rrd`;
      const response = await fetch(url);
      await response.body?.cancel();
      if (response.ok) return { url };
    }
    return writeRecording(recordingRequest(trace), this.#jobs, ({ progress, message }) => {
      if (this.#source !== trace) return;
      const text = `Writing the recording: ${message || 'starting'} …`;
      setPanelState(this.#host, 'loading', text, progress);
    });
  }

  /**
   * Sets our time until the recording keeps it: its blueprint, which arrives later, sets another one.
   * @param {WebViewer} viewer
   * @param {Trace | RecordingFile[]} source
   */
  async #settle(viewer, source) {
    let stable = 0;
    for (let i = 0; i < SETTLE_FRAMES && stable < STABLE_FRAMES && this.#source === source; i++) {
      const { active_store_id: active, recordings } = await viewer.get_state();
      const time = recordings.find((r) => r.store_id === active)?.current_time;
      stable = time?.timeline === 'step' && Number(time.time) === this.#step ? stable + 1 : 0;
      // Before the first data arrive, the viewer would report a missing timeline.
      const hasData = time?.timeline === 'step' || i >= SETTLE_FRAMES / 2;
      if (!stable)
        await (hasData ? viewer.set_time(timeOf(this.#step)).catch(() => frame()) : frame());
    }
    if (this.#source === source) this.#settled = source;
  }

  /** @returns {Promise<WebViewer>} */
  #start() {
    if (!this.#starting) {
      this.#starting = this.#startViewer();
      this.#starting.catch(() => (this.#starting = null));
    }
    return this.#starting;
  }

  async #startViewer() {
    console.debug = () => {}; // the viewer logs every shader, which takes seconds
    const { WebViewer } = await import('/vendor/rerun/viewer.js');
    const viewer = new WebViewer();
    viewer.on('time_update', ({ time }) => this.#timeUpdate(time));
    const place = create('div', { className: 'viewer', role: 'application' });
    place.ariaLabel = 'Rerun viewer';
    this.#host.append(place);
    await viewer.start(null, place, {
      width: '100%',
      height: '100%',
      hide_welcome_screen: true,
      check_for_updates_on_startup: false,
      theme: 'system',
    });
    this.#viewer = viewer;
    // The viewer takes the focus, and with it the keys, when it starts.
    if (document.activeElement instanceof HTMLElement) document.activeElement.blur();
    return viewer;
  }

  /** Whether the viewer's time and the page's step are coupled. */
  get #isCoupled() {
    const { state } = this.#store;
    return (
      this.#open &&
      (!this.#files || this.#isFileOfRun) &&
      this.#settled === (this.#files ?? this.#trace) &&
      this.#trace !== null &&
      isSameRun(this.#trace.selection, state) && // no longer while the next run is loading
      this.#host.dataset.state === 'ready'
    );
  }

  /**
   * Sets the viewer's time, one request after the other; of several pending steps only the newest is set.
   * @param {number} step
   */
  async #seek(step) {
    this.#pending = step;
    if (this.#busy || !this.#viewer || !this.#isCoupled) return;
    this.#busy = true;
    while (this.#pending !== null) {
      const start = performance.now();
      [this.#echo, this.#pending] = [this.#pending, null];
      try {
        await this.#viewer.set_time(timeOf(this.#echo));
        // The viewer reports nothing if it has this time already.
        for (let i = 0; i < ECHO_FRAMES && this.#echo !== null && this.#pending === null; i++)
          await frame();
      } catch (error) {
        console.warn('Rerun rejected the time:', error);
      }
      this.#echo = null;
      // The viewer draws in this thread: leave the same time to the rest of the page.
      await pause(performance.now() - start);
    }
    this.#busy = false;
  }

  /** @param {number} time */
  #timeUpdate(time) {
    const step = Math.round(time);
    const isOlder = this.#echo !== null || this.#pending !== null; // than the step that we are setting
    if (step === this.#echo) this.#echo = null;
    if (isOlder || !this.#isCoupled || step === this.#step) return;
    if (this.#trace && step >= 0 && step < this.#trace.steps)
      this.#store.set({ step, playing: false }, { origin: 'rerun' });
  }
}

/**
 * @param {number} step
 * @returns {{timeline: string, sequence: number, play_state: 'paused'}}
 */
const timeOf = (step) => ({ timeline: 'step', sequence: step, play_state: 'paused' });

const frame = () => new Promise((resolve) => requestAnimationFrame(resolve));
