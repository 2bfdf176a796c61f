/** The Recordings tab: search, import, rename, compare, delete and restore recordings and reports. */

/** @import { State, Store } from '../core/state.js' */
/** @import { Job, RecordingEntry, RecordingList, ReportEntry, ReportList } from '../types/server.js' */
/** @import { Jobs } from '../widgets/jobs.js' */
/** @import { Status } from '../widgets/status_line.js' */
/** @import { Run } from './recorded_run.js' */
/** @import { Rerun } from './rerun.js' */
/** @import { TrashedFile } from './trash.js' */

import { element, html, messageOf } from '../core/dom.js';
import { formatBytes, plural, sentence } from '../core/units.js';
import * as api from '../data/api.js';
import { sum } from '../data/arrays.js';
import { acceptDrops } from '../widgets/file_drop.js';
import { FileTable } from '../widgets/file_table.js';
import { isActive, jobSummary } from '../widgets/jobs.js';
import { setPanelState } from '../widgets/panel_state.js';
import { StatusLine } from '../widgets/status_line.js';
import { Uploads } from '../widgets/upload.js';
import { fileActions } from './file_actions.js';
import { differences, openRecordings, recordedRun, selectRun } from './recorded_run.js';
import { RECORDING_COLUMNS, REPORT_COLUMNS } from './recording_columns.js';
import { SelectionBar } from './selection_bar.js';
import { trash } from './trash.js';

const POLL_INTERVAL = 4000; // ms; other clients may change the files
const READING_INTERVAL = 700; // ms, while the server reads a new file
const NO_RECORDINGS =
  'No recordings yet. “Save .rrd” above writes the current run; “Add .rrd…” imports a file.';
const READ_ONLY = 'Read-only server: nothing can be changed';

const BODY = `
  <div class="top">
    <input type="search" placeholder="Search name, task, filter" aria-label="Search recordings and reports" autocomplete="off" spellcheck="false">
    <span class="summary" aria-live="polite"></span>
    <button type="button" class="text add" title="Add .rrd files of any application. Files can also be dropped on this tab">Add .rrd…</button>
    <input type="file" accept=".rrd" multiple hidden aria-label="Recordings to add">
  </div>
  <div class="selection" hidden></div>
  <ul class="uploads"></ul>
  <p class="status" role="status" hidden></p>
  <div class="scroll" tabindex="-1">
    <table class="recordings" aria-label="Recordings"><thead></thead><tbody></tbody></table>
    <p class="rest"></p>
    <section class="reports"><h2>Reports</h2><table aria-label="Reports"><thead></thead><tbody></tbody></table></section>
    <details class="trash" hidden></details>
  </div>
  <div class="drop" hidden><p>Drop <b>.rrd</b> files to add them</p></div>
  <p class="note"></p>`;

export class Recordings {
  #host;
  #store;
  #jobs;
  #rerun;
  #search;
  #recordings;
  #reports;
  #selection;
  #uploads;
  #showTrash;
  #status;
  /** @type {{recordings: RecordingList, reports: ReportList} | null} */
  #files = null;
  #reply = ''; // last files as JSON
  #highlighted = ''; // file to highlight once it is listed
  #import = ''; // ID of the job that imports a run
  #open = false;
  #timer = 0;

  /**
   * @param {HTMLElement} host
   * @param {Store} store
   * @param {Jobs} jobs
   * @param {Rerun} rerun displays recordings
   */
  constructor(host, store, jobs, rerun) {
    this.#host = host;
    this.#store = store;
    this.#jobs = jobs;
    this.#rerun = rerun;
    host.innerHTML = BODY;
    this.#search = element('[type=search]', HTMLInputElement, host);
    this.#selection = new SelectionBar(html('.selection', host), {
      open: (files) => this.#openInRerun(files),
      compare: (files) => this.#compare(files),
      clear: () => this.#draw(),
    });
    const actions = fileActions(store.catalog, this.#readOnlyReason, {
      openInRerun: (file) => this.#openInRerun([file]),
      openRun: (run) => this.#openRun(run),
      importRun: (file) => this.#importRun(file),
      rename: (file) => this.#rename(file),
      remove: (file, kind) => this.#delete(file, kind),
    });
    this.#recordings = new FileTable(
      element('table.recordings', HTMLTableElement, host),
      RECORDING_COLUMNS,
      {
        actions: (file) => actions.forRecording(file),
        sort: { name: 'when', down: true },
        selection: this.#selection,
      },
    );
    this.#reports = new FileTable(
      element('.reports table', HTMLTableElement, host),
      REPORT_COLUMNS,
      { actions: (file) => actions.forReport(file), sort: { name: 'when', down: true } },
    );
    this.#uploads = new Uploads(html('.uploads', host), (added) => this.#showAdded(added));
    this.#status = new StatusLine(html('.status', host));
    this.#showTrash = trash(
      html('.trash', host),
      this.#readOnlyReason,
      (file) => this.#restore(file),
      () => this.#emptyTrash(),
    );
    jobs.listen((list) => this.#followJobs(list));
    this.#bindControls();
    acceptDrops(host, html('.drop', host), (files) => this.#upload(files));
  }

  /** Whether the tab is selected. */
  set open(/** @type {boolean} */ open) {
    if (open && !this.#open) this.load();
    this.#open = open;
    if (!open) clearTimeout(this.#timer);
  }

  /**
   * Highlights a file as soon as it is listed.
   * @param {string} name
   */
  point(name) {
    this.#search.value = '';
    this.#highlighted = name;
    this.#reply = '';
    this.load();
  }

  /** Gets the files, and again at intervals while the tab is selected. */
  async load() {
    clearTimeout(this.#timer);
    if (!this.#files) setPanelState(this.#host, 'loading', 'Loading …');
    try {
      const [recordings, reports] = await Promise.all([api.recordings(), api.reports()]);
      const reply = JSON.stringify([recordings, reports]);
      if (reply !== this.#reply) {
        this.#reply = reply;
        this.#files = { recordings, reports };
        this.#draw();
      }
      setPanelState(this.#host, 'ready');
    } catch (error) {
      if (!this.#files) setPanelState(this.#host, 'error', messageOf(error));
      else this.#status.show({ text: messageOf(error) });
    }
    clearTimeout(this.#timer);
    if (!this.#open) return;
    const isReading = this.#list.some(({ reading }) => reading);
    this.#timer = setTimeout(
      () => (document.hidden ? this.#loadWhenVisible() : this.load()),
      isReading ? READING_INTERVAL : POLL_INTERVAL,
    );
  }

  #loadWhenVisible() {
    document.addEventListener('visibilitychange', () => this.#open && this.load(), { once: true });
  }

  /** @returns {RecordingEntry[]} */
  get #list() {
    return this.#files?.recordings.recordings ?? [];
  }

  get #readOnlyReason() {
    return this.#store.catalog.read_only ? READ_ONLY : undefined;
  }

  #draw() {
    if (!this.#files) return;
    const { recordings, reports } = this.#files;
    this.#selection.show(this.#list);
    const all = this.#list;
    const matches = all.filter((file) => this.#matches(file));
    this.#recordings.show(matches);
    this.#reports.show(reports.reports.filter((file) => this.#matches(file)));
    html('section.reports', this.#host).hidden = !reports.reports.length;
    const total = plural(all.length, 'recording');
    const count = matches.length < all.length ? `${matches.length} of ${total}` : total;
    const used = recordings.bytes + sum(reports.reports.map(({ bytes }) => bytes));
    html('.summary', this.#host).textContent =
      `${count} · ${formatBytes(used)} used, ${formatBytes(recordings.free)} free`;
    const none = this.#store.catalog.read_only ? 'No recordings.' : NO_RECORDINGS;
    const hint = all.length ? 'No recording matches all words.' : none;
    html('.rest', this.#host).textContent = matches.length ? '' : hint;
    this.#showTrash([
      ...recordings.deleted.map((file) => ({ ...file, kind: /** @type {const} */ ('recordings') })),
      ...reports.deleted.map((file) => ({ ...file, kind: /** @type {const} */ ('reports') })),
    ]);
    if (!this.#list.some(({ name }) => name === this.#highlighted)) return;
    this.#recordings.point(this.#highlighted);
    this.#highlighted = '';
  }

  /**
   * Returns whether a file matches all words of the search.
   * @param {RecordingEntry | ReportEntry} file
   */
  #matches(file) {
    const { name, task, filter, faults } = file;
    const more = 'application' in file ? [file.application, file.run?.data] : [];
    const text = [name, task, filter, faults, ...more].join(' ').toLowerCase();
    const words = this.#search.value.toLowerCase().split(/\s+/);
    return words.every((word) => text.includes(word));
  }

  /** @param {RecordingEntry} file */
  #importRun(file) {
    return this.#attempt(async () => {
      const { job } = await api.importRun(file);
      if (job.state === 'done') location.assign(`/${job.link}`);
      this.#import = job.id;
      this.#status.show({ text: `Importing the run of ${file.name} …` });
      await this.#jobs.refresh();
    });
  }

  /** @param {Job[]} list */
  #followJobs(list) {
    const job = list.find(({ id }) => id === this.#import);
    if (job?.state === 'done') {
      location.assign(`/${job.link}`); // reloads the page, because the catalog has changed
    } else if (job && !isActive(job)) {
      this.#import = '';
      this.#status.show({ text: jobSummary(job), failed: true });
    }
    if (this.#open) this.load();
  }

  /**
   * @param {Run} run
   * @param {Partial<State>} [patch]
   */
  #openRun(run, patch = { tab: 'scene' }) {
    this.#store.set({ ...selectRun(this.#store.catalog, this.#store.state, run), ...patch });
  }

  /** @param {RecordingEntry[]} files */
  #openInRerun(files) {
    this.#store.set(openRecordings(this.#store.catalog, this.#store.state, files));
  }

  /** Displays the recordings that the state names in Rerun's viewer, or the current run. */
  async showOpened() {
    const { recording } = this.#store.state;
    if (!recording) return this.#rerun.files(null);
    try {
      const { recordings } = await api.recordings();
      if (recording !== this.#store.state.recording) return;
      const files = recording.split('/').map((name) => {
        const file = recordings.find((entry) => entry.name === name);
        if (!file) throw new Error(`The recording ${name} no longer exists.`);
        return { ...file, isOf: recordedRun(file) };
      });
      this.#rerun.files(files);
    } catch (error) {
      this.#rerun.files(null, messageOf(error));
    }
  }

  /** @param {RecordingEntry[]} files two of them */
  #compare(files) {
    const [run, comparison] = files.map(recordedRun);
    if (run && comparison)
      this.#openRun(run, { against: differences(run, comparison), tab: 'compare' });
  }

  /** @param {RecordingEntry} file */
  #rename(file) {
    const stem = file.name.replace(/\.rrd$/, '');
    this.#recordings.edit(file, `New name of ${file.name}`, stem, async (text) => {
      const { name } = await api.renameRecording(file, text);
      this.#selection.rename(file.name, name);
      const opened = this.#store.state.recording.split('/');
      if (opened.includes(file.name)) {
        const recording = opened.map((each) => (each === file.name ? name : each)).join('/');
        this.#store.set({ recording });
      }
      this.#highlighted = name;
      await this.load();
    });
  }

  /**
   * @param {{name: string, url: string}} file
   * @param {TrashedFile['kind']} kind
   */
  async #delete(file, kind) {
    await this.#attempt(async () => {
      const { deleted: id } = await api.deleteFile(file);
      const undo = () => this.#restore({ id, name: file.name, kind });
      return { text: `${file.name} was moved to the trash.`, undo };
    });
    this.#status.focus();
  }

  /** @param {TrashedFile} file */
  #restore({ id, name, kind }) {
    return this.#attempt(async () => {
      await api.restoreFile(kind, id);
      this.#highlighted = kind === 'recordings' ? name : '';
      return { text: `${name} was restored.` };
    });
  }

  #emptyTrash() {
    return this.#attempt(async () => {
      const replies = [await api.emptyTrash('recordings'), await api.emptyTrash('reports')];
      const freed = replies.reduce((sum, reply) => sum + reply.freed, 0);
      return { text: `The trash was emptied: ${formatBytes(freed)} freed.` };
    });
  }

  /**
   * Performs an action, updates the list, and shows the status that the action returns, or its error.
   * @param {() => Promise<Status | void>} action
   */
  async #attempt(action) {
    const status = await action().catch((error) => ({ text: messageOf(error), failed: true }));
    await this.load();
    if (status) this.#status.show(status);
  }

  /** @param {RecordingEntry} file */
  #showAdded({ name, problem, application }) {
    this.#status.show({ text: `${name} was added.${problem && ` ${sentence(problem)}`}` });
    if (application) this.#highlighted = name;
    this.load();
  }

  /** @param {File[]} files */
  #upload(files) {
    if (this.#readOnlyReason) return this.#status.show({ text: `${READ_ONLY}.`, failed: true });
    const names = new Set(this.#list.map(({ name }) => name));
    this.#uploads.add(files, names, this.#files?.recordings.largest ?? Infinity);
  }

  #bindControls() {
    const picker = element('[type=file]', HTMLInputElement, this.#host);
    const add = element('.add', HTMLButtonElement, this.#host);
    if (this.#readOnlyReason) [add.disabled, add.title] = [true, this.#readOnlyReason];
    add.addEventListener('click', () => picker.click());
    picker.addEventListener('change', () => {
      this.#upload([...(picker.files ?? [])]);
      picker.value = '';
    });
    this.#search.addEventListener('input', () => this.#draw());
    this.#search.addEventListener('keydown', (event) => {
      if (event.key !== 'Escape') return;
      this.#search.value = '';
      this.#draw();
    });
  }
}
