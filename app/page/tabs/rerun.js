/** Rerun's viewer in the page, loaded when its tab is first opened; its time and the page's step follow each other. It shows
 *  the page's run, or files in its place, which keep their own time. */

import { recordingRequest } from '../data/api.js';
import { setPanelState } from '../widgets/panel_state.js';
import { writeRecording } from '../widgets/save_button.js';

const SETTLING = 30; // frames at most until a recording that is being opened keeps our time
const ECHO_FRAMES = 4; // that the viewer may take to tell back a time that we set

export class Rerun {
  #host;
  #jobs;
  #moved;
  #viewer = null;
  #starting = null;
  #shown = null; // the trace whose recording is open, or the files
  #trace = null;
  #files = null; // that are to be shown in place of the trace
  #settled = null; // of what is shown, once it keeps our time
  #opened = []; // store ids in the viewer that we opened
  #bar = document.createElement('p');
  #step = 0;
  #pending = null;
  #busy = false;
  #echo = null; // the step that we set last, until the viewer has told it back
  #open = false;

  /** @param {HTMLElement} host @param {import('../widgets/jobs.js').Jobs} jobs @param {(step: number) => void} moved called when the time was moved in the viewer. */
  constructor(host, jobs, moved) {
    [this.#host, this.#jobs, this.#moved] = [host, jobs, moved];
    [this.#bar.className, this.#bar.hidden] = ['files', true];
    this.#bar.innerHTML =
      '<span></span><button type="button" class="text">Back to the run</button>';
    this.#bar.querySelector('button').addEventListener('click', () => this.files(null));
    host.append(this.#bar);
  }

  /** @param {import('../data/trace.js').Trace} trace */
  show(trace) {
    this.#trace = trace;
    this.files(null);
  }

  /** Shows files in place of the run, until another run is shown; null for the run again. @param {{name: string, url: string}[] | null} files */
  files(files) {
    this.#files = files;
    this.#bar.hidden = !files;
    this.#bar.firstElementChild.textContent = files
      ? files.map(({ name }) => name).join(' and ')
      : '';
    if (this.#open && (files || this.#trace)) this.#load();
  }

  /** The tab is in front, or no longer. */
  set open(open) {
    this.#open = open;
    if (open && (this.#files || this.#trace)) this.#load();
  }

  /** @param {number} step @param {boolean} fromRerun whether it was moved in the viewer itself. */
  move(step, fromRerun) {
    this.#step = step;
    if (!fromRerun) this.#seek(step);
  }

  /** What the viewer shows: for tests. */
  async getState() {
    return this.#viewer ? this.#viewer.get_state() : null;
  }

  async #load() {
    const [trace, files] = [this.#trace, this.#files];
    if (this.#shown === (files ?? trace)) {
      this.#seek(this.#step);
      return;
    }
    const shown = (this.#shown = files ?? trace);
    this.#settled = null;
    try {
      setPanelState(this.#host, 'loading', files ? 'Starting Rerun …' : 'Writing the recording …');
      const [recordings] = await Promise.all([
        files ?? Promise.all([trace.stream ? this.#growing(trace) : this.#record(trace)]),
        this.#start(),
      ]);
      if (this.#shown !== shown) return;
      setPanelState(this.#host, 'loading', 'Opening the recording …');
      const { store_ids: kept } = await this.#viewer.open(
        recordings.map(({ url }) => new URL(url, location.href).href),
      );
      const others = this.#opened.filter((id) => !kept.includes(id));
      this.#opened = [...others, ...kept];
      if (this.#shown !== shown) return;
      this.#viewer.override_panel_state(
        'blueprint',
        recordings.length > 1 ? 'expanded' : undefined,
      );
      setPanelState(this.#host, 'ready');
      // What follows takes a drawing or more for each answer: the recording can be looked at meanwhile.
      if (!files) await this.#settle(shown);
      if (this.#shown !== shown) return;
      this.#opened = kept;
      await Promise.allSettled(others.map((id) => this.#viewer.close({ store_ids: [id] }))); // somebody may have before
      this.#seek(this.#step);
    } catch (error) {
      if (this.#shown !== shown) return;
      this.#shown = null;
      setPanelState(this.#host, 'error', `Rerun cannot show this: ${error.message ?? error}`);
    }
  }

  #record(trace) {
    return writeRecording(recordingRequest(trace, true), this.#jobs, ({ progress, message }) => {
      if (this.#shown === trace)
        setPanelState(this.#host, 'loading', `Writing the recording: ${message || 'starting'} …`, progress);
    });
  }

  /** The recording that a live run writes itself, which is sent on as it grows; of one that writes none, what there is by now. */
  async #growing(trace) {
    const url = `/api/live/${encodeURIComponent(trace.live.name)}.rrd`;
    const found = await fetch(url);
    await found.body.cancel();
    return found.ok ? { url } : this.#record(trace);
  }

  /** A recording that has just been opened sets its own time once more when its blueprint comes: insist on ours. */
  async #settle(shown) {
    for (let tries = 0, kept = 0; tries < SETTLING && kept < 3 && this.#shown === shown; tries++) {
      const { active_store_id: active, recordings } = await this.#viewer.get_state();
      const now = recordings.find((r) => r.store_id === active)?.current_time;
      kept = now?.timeline === 'step' && Number(now.time) === this.#step ? kept + 1 : 0;
      const time = { timeline: 'step', sequence: this.#step, play_state: 'paused' };
      if (!kept) await this.#viewer.set_time(time).catch(() => frame());
    }
    if (this.#shown === shown) this.#settled = shown;
  }

  #start() {
    this.#starting ??= (async () => {
      // Its log of every shader it compiles is tens of thousands of lines and takes seconds.
      console.debug = () => {};
      const { WebViewer } = await import('/vendor/rerun/viewer.js');
      const viewer = new WebViewer();
      viewer.on('time_update', (event) => this.#heard(event.time));
      const place = document.createElement('div');
      place.className = 'viewer';
      place.setAttribute('role', 'application'); // it takes the keys while it has the focus
      place.setAttribute('aria-label', 'Rerun’s viewer');
      this.#host.append(place);
      await viewer.start(null, place, {
        width: '100%',
        height: '100%',
        hide_welcome_screen: true,
        check_for_updates_on_startup: false,
        theme: 'system',
      });
      this.#viewer = viewer;
      document.activeElement?.blur(); // it takes the keys as it starts; they are the page's until somebody clicks in it
    })();
    this.#starting.catch(() => (this.#starting = null));
    return this.#starting;
  }

  /** Whether the viewer's time and ours are the same. */
  get #follows() {
    return (
      this.#viewer !== null &&
      !this.#files &&
      this.#open &&
      this.#settled === this.#trace &&
      this.#host.dataset.state === 'ready'
    );
  }

  /** Moves the viewer's time, one request at a time: the newest wins. */
  async #seek(step) {
    this.#pending = step;
    if (this.#busy || !this.#follows) return;
    this.#busy = true;
    while (this.#pending !== null) {
      const started = performance.now();
      [this.#echo, this.#pending] = [this.#pending, null];
      try {
        await this.#viewer.set_time({
          timeline: 'step',
          sequence: this.#echo,
          play_state: 'paused',
        });
        // It tells nothing back if it was there already. Its frames are ours: how long they take does not matter.
        for (let i = 0; i < ECHO_FRAMES && this.#echo !== null && this.#pending === null; i++)
          await frame();
      } catch (error) {
        console.warn('Rerun did not take the time:', error);
      }
      this.#echo = null;
      // It draws in our thread: as long as it took, the rest of the page has its turn.
      await new Promise((resolve) => setTimeout(resolve, performance.now() - started));
    }
    this.#busy = false;
  }

  #heard(time) {
    const step = Math.round(time);
    const ours = this.#echo !== null || this.#pending !== null; // on its way: whatever comes is older
    if (step === this.#echo) this.#echo = null;
    if (ours || !this.#follows || step === this.#step) return;
    if (step >= 0 && step < this.#trace.steps) this.#moved(step);
  }
}

const frame = () => new Promise((resolve) => requestAnimationFrame(resolve));
