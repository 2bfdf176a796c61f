/** What the workspace keeps: recordings, the user's own among them, and reports; opened, compared, named, tagged, deleted, had back. */

import { Uploads } from '../widgets/upload.js';
import * as api from '../data/api.js';
import { FileTable } from '../widgets/file_table.js';
import { jobSummary, isActive } from '../widgets/jobs.js';
import { setPanelState } from '../widgets/panel_state.js';
import { formatBytes, sentence } from '../core/units.js';

const AGAIN = 4000; // ms until the list is asked for again: another browser may have changed it
const SOON = 700; // while a file is being looked into
const READ_ONLY = 'This server only shows: nothing can be changed here';
const TIME = new Intl.DateTimeFormat('en-GB', { hour: '2-digit', minute: '2-digit' });
const DAY = new Intl.DateTimeFormat('en-GB', { day: 'numeric', month: 'short' });

const BODY = `
  <div class="top">
    <input type="search" placeholder="Search name, task, filter, tag" aria-label="Search recordings and reports" autocomplete="off" spellcheck="false">
    <span class="told" aria-live="polite"></span>
    <button type="button" class="text add" title="An .rrd file of any application, to open it here and keep it. Or drop it anywhere on this tab">Add .rrd…</button>
    <input type="file" accept=".rrd" multiple hidden aria-label="Recordings to add">
  </div>
  <div class="chosen" hidden><span></span><button type="button" class="text both">Both in Rerun</button><button type="button" class="text compare">Compare the runs</button><span class="apart"></span><span class="spacer"></span><button type="button" class="text quiet none">Choose none</button></div>
  <ul class="adding"></ul>
  <p class="said" role="status" hidden><span></span> <button type="button" class="text">Undo</button><button type="button" class="quiet" aria-label="Dismiss">×</button></p>
  <div class="scroll" tabindex="-1">
    <table class="recordings" aria-label="Recordings"><thead></thead><tbody></tbody></table>
    <p class="rest"></p>
    <p class="automatic" hidden><span></span> <button type="button" class="text quiet">Show</button></p>
    <section class="reports"><h2>Reports</h2><table aria-label="Reports"><thead></thead><tbody></tbody></table></section>
    <details class="trash" hidden><summary>Trash</summary><ul></ul><p><button type="button" class="text empty">Empty the trash</button> <span class="sure" hidden>For good? <button type="button" class="text yes">Delete for good</button> <button type="button" class="text no">Keep</button></span></p></details>
  </div>
  <div class="drop" hidden><p>Drop <b>.rrd</b> files to add them</p></div>
  <p class="note"></p>`;

const words = (name, title, help, value = (file) => file[name] ?? null) => ({
  name,
  title,
  help,
  value,
  content: (file) => String(value(file) ?? '–'),
});
const OF_A_RUN = [
  words('task', 'task', 'What it is of'),
  words('filter', 'filter', 'That made it'),
  { ...words('episode', 'ep.', 'Index of the episode'), number: true },
  {
    ...words('faults', 'sensors', 'How they were broken', ({ task, faults }) =>
      task === null ? null : faults || 'as recorded',
    ),
    hint: ({ faults }) => faults,
  },
];
const size = {
  name: 'bytes',
  title: 'size',
  help: 'On the disk',
  value: (file) => file.bytes,
  content: (file) => formatBytes(file.bytes),
  number: true,
};
const when = (name) => ({
  name: 'when',
  title: 'when',
  help: 'It was written',
  value: (file) => Date.parse(file[name]),
  content: (file) => moment(new Date(file[name])),
  hint: (file) => new Date(file[name]).toLocaleString('en-GB'),
  number: true,
});
const data = {
  ...words('data', 'data', 'Data set, as it is named here', (file) => file.run?.data ?? null),
  hint: (file) => file.data_hash && `Episode ${file.data_hash.slice(0, 12)}`,
};

export class Library {
  #host;
  #store;
  #catalog;
  #jobs;
  #rerun;
  #recordings;
  #reports;
  #adding;
  #kept = null; // what the server keeps
  #read = ''; // as it said it last
  #chosen = new Set();
  #point = '';
  #automatic = false; // whether those are listed that were written for the Rerun tab
  #undo = null;
  #awaited = ''; // id of the job that reads a run
  #open = false;
  #timer = 0;

  /**
   * @param {HTMLElement} host @param {api.Catalog} catalog @param {import('../core/state.js').Store} store @param {import('../widgets/jobs.js').Jobs} jobs
   * @param {import('./rerun.js').Rerun} rerun that shows recordings
   */
  constructor(host, catalog, store, jobs, rerun) {
    [this.#host, this.#catalog, this.#store, this.#jobs, this.#rerun] = [
      host,
      catalog,
      store,
      jobs,
      rerun,
    ];
    host.innerHTML = BODY;
    const name = {
      name: 'name',
      title: 'name',
      help: 'Of the file',
      value: (file) => file.name,
      content: (file) => this.#tags(file),
      hint: (file) => (file.reading ? '' : file.problem),
    };
    this.#recordings = new FileTable(
      this.#part('.recordings'),
      [name, ...OF_A_RUN, data, size, when('modified')],
      {
        actions: (file) => this.#acts(file),
        sort: { name: 'when', down: true },
        selection: { has: (file) => this.#chosen.has(file), toggle: (file) => this.#choose(file) },
      },
    );
    this.#reports = new FileTable(
      this.#part('.reports table'),
      [{ ...name, content: () => '', hint: ({ title }) => title }, ...OF_A_RUN, size, when('made')],
      {
        actions: (file) => this.#actsOfReport(file),
        sort: { name: 'when', down: true },
      },
    );
    this.#adding = new Uploads(this.#part('.adding'), (added) => this.#added(added));
    jobs.listen((list) => this.#hear(list));
    this.#take();
    this.#takeDrops();
  }

  /** Whether the panel can be seen; nothing is asked for before. */
  set open(open) {
    if (open && !this.#open) this.load();
    this.#open = open;
    if (!open) clearTimeout(this.#timer);
  }

  /** Shows where a file is, once it is there. */
  point(name) {
    this.#part('[type=search]').value = '';
    [this.#point, this.#read] = [name, ''];
    this.load();
  }

  /** Asks what there is, now and again for as long as the panel can be seen. */
  async load() {
    clearTimeout(this.#timer);
    if (!this.#kept) setPanelState(this.#host, 'loading', 'Loading …');
    try {
      const [kept, made] = await Promise.all([api.recordings(), api.reports()]);
      const read = JSON.stringify([kept, made]);
      if (read !== this.#read) {
        [this.#read, this.#kept] = [
          read,
          {
            ...kept,
            reports: made.reports,
            trash: [
              ...kept.deleted.map((one) => ({ ...one, of: 'recordings' })),
              ...made.deleted.map((one) => ({ ...one, of: 'reports' })),
            ],
          },
        ];
        this.#draw();
      }
      setPanelState(this.#host, 'ready');
    } catch (error) {
      if (!this.#kept) setPanelState(this.#host, 'error', error.message);
      else this.#say(error.message);
    }
    clearTimeout(this.#timer);
    const soon = this.#kept?.recordings.some(({ reading }) => reading);
    if (this.#open)
      this.#timer = setTimeout(
        () => (document.hidden ? this.#later() : this.load()),
        soon ? SOON : AGAIN,
      );
  }

  #later() {
    document.addEventListener('visibilitychange', () => this.#open && this.load(), { once: true });
  }

  #part(selector) {
    return this.#host.querySelector(selector);
  }

  get #readOnly() {
    return this.#catalog.read_only ? READ_ONLY : undefined;
  }

  #draw() {
    const { recordings, reports, trash, bytes: used, free } = this.#kept;
    const there = new Set(recordings.map(({ name }) => name));
    for (const name of this.#chosen) if (!there.has(name)) this.#chosen.delete(name);
    const kept = recordings.filter(({ automatic }) => this.#automatic || !automatic);
    const found = kept.filter((file) => this.#sought(file));
    this.#recordings.show(found);
    this.#reports.show(reports.filter((file) => this.#sought(file)));
    this.#part('section.reports').hidden = !reports.length;
    const many = `${kept.length} recording${kept.length === 1 ? '' : 's'}`;
    const what = found.length < kept.length ? `${found.length} of ${many}` : many;
    const disk = reports.reduce((sum, one) => sum + one.bytes, used);
    this.#part('.told').textContent =
      `${what} · ${formatBytes(disk)} used, ${formatBytes(free)} free`;
    const none =
      'None yet. “Save .rrd” above writes one of the run that is shown; “Add .rrd…” takes one from elsewhere.';
    this.#part('.rest').textContent = kept.length
      ? found.length
        ? ''
        : 'No recording has all these words.'
      : none;
    this.#drawAutomatic(recordings.filter((file) => file.automatic && this.#sought(file)));
    this.#drawTrash(trash);
    this.#drawChosen();
    if (!there.has(this.#point)) return;
    this.#recordings.point(this.#point);
    this.#point = '';
  }

  /** Those that nobody asked to be kept. */
  #drawAutomatic(files) {
    const host = this.#part('.automatic');
    host.hidden = !files.length;
    const [text, button] = host.children;
    const size = formatBytes(files.reduce((sum, one) => sum + one.bytes, 0));
    text.textContent = `${files.length} ${files.length === 1 ? 'was' : 'were'} written for the Rerun tab, ${size}; the oldest go when there are many.`;
    button.textContent = this.#automatic ? 'Hide' : 'Show';
  }

  #sought({ name, task, filter, tags = [], faults, application = '', run }) {
    const text = [name, task, filter, ...tags, faults, application, run?.data]
      .join(' ')
      .toLowerCase();
    return this.#part('[type=search]')
      .value.toLowerCase()
      .split(/\s+/)
      .every((word) => text.includes(word));
  }

  /** What stands behind a name: its tags; of a file that is no run of ours, what it is. */
  #tags(file) {
    const host = document.createElement('span');
    host.className = 'tags';
    if (file.reading) host.append(note('is looked into …'));
    else if (!file.application) host.append(note('cannot be read', 'bad'));
    else if (file.problem) host.append(note(`of ${file.application}`));
    else if (file.automatic) host.append(note('for the Rerun tab'));
    for (const tag of file.tags) {
      const button = Object.assign(document.createElement('button'), {
        type: 'button',
        className: 'tag',
        textContent: tag,
        title: `Search for ${tag}`,
      });
      button.dataset.part = `tag ${tag}`;
      button.addEventListener('click', () => this.#search(tag));
      host.append(button);
    }
    return host;
  }

  #search(text) {
    const field = this.#part('[type=search]');
    field.value = field.value.trim() === text ? '' : text;
    this.#draw();
  }

  /** @returns {import('../widgets/file_table.js').Act[]} */
  #acts(file) {
    const unread = file.reading
      ? 'It is looked into just now'
      : file.application
        ? undefined
        : sentence(file.problem);
    return [
      { name: 'Open in Rerun', key: 'Enter', run: () => this.#show([file]), disabledReason: unread },
      { name: 'Open the run here', ...this.#run(file, unread) },
      ...(file.automatic
        ? [
            {
              name: 'Keep',
              run: () => this.#keep(file),
              disabledReason: this.#readOnly,
              hint: 'It was written for the Rerun tab, and goes when there are many.',
            },
          ]
        : []),
      { name: 'Rename', key: 'F2', run: () => this.#rename(file), disabledReason: this.#readOnly },
      { name: 'Tags', run: () => this.#tag(file), disabledReason: this.#readOnly },
      { name: `Download, ${formatBytes(file.bytes)}`, href: file.url, download: file.name },
      {
        name: 'Delete',
        key: 'Delete',
        run: () => this.#delete(file, 'recordings'),
        disabledReason: this.#readOnly,
      },
    ];
  }

  /** The run of a recording: this server's own, or read out of the file. */
  #run(file, unread) {
    if (file.run) return { run: () => this.#store.set({ ...this.#selection(file), tab: 'scene' }) };
    const known = this.#catalog.tasks.some(({ name }) => name === file.task);
    if (unread || file.problem || !known)
      return { disabledReason: unread ?? sentence(file.problem || `This server has no task ${file.task}`) };
    return {
      run: () => this.#readRun(file),
      disabledReason: this.#readOnly,
      hint: `As it was recorded. ${file.why_not}`,
    };
  }

  /** Has a run read out of its file, and opens it when that is done. */
  #readRun(file) {
    return this.#try(async () => {
      const { job } = await api.importRun(file);
      if (job.state === 'done') location.assign(`/${job.link}`);
      this.#awaited = job.id;
      this.#say(`The run in ${file.name} is read; it opens in a moment.`);
      await this.#jobs.refresh();
    });
  }

  #hear(list) {
    const job = list.find(({ id }) => id === this.#awaited);
    if (job?.state === 'done')
      location.assign(`/${job.link}`); // its episode is new to this page
    else if (job && !isActive(job)) [this.#awaited] = ['', this.#say(jobSummary(job), null, true)];
    if (this.#open) this.load();
  }

  #actsOfReport(file) {
    return [
      { name: 'Open', key: 'Enter', href: `${file.url}?shown=true`, newWindow: true },
      {
        name: 'Open its run here',
        run: () => this.#store.set({ ...this.#selection({ ...file, run: file }), tab: 'scene' }),
        disabledReason: this.#lacking(file),
      },
      { name: 'Download the page', href: file.url, download: `${file.name}.html` },
      ...(file.pdf
        ? [{ name: 'Download the PDF', href: file.pdf, download: `${file.name}.pdf` }]
        : []),
      {
        name: 'Delete',
        key: 'Delete',
        run: () => this.#delete(file, 'reports'),
        disabledReason: this.#readOnly,
      },
    ];
  }

  /** Why a report's run cannot be opened: a filter of this name may have gone since. */
  #lacking({ task, filter, episode }) {
    const found = this.#catalog.tasks.find(({ name }) => name === task);
    if (!found?.filters.some(({ name }) => name === filter))
      return `Filter ${filter} of ${task} is not one of this server’s.`;
    return found.data.some((set) => set.episodes.some(({ index }) => index === episode))
      ? undefined
      : `No data set here has an episode ${episode}.`;
  }

  /** The state that shows a file's run. */
  #selection({ task, episode, faults, run }) {
    const { state } = this.#store;
    const found = this.#catalog.tasks.find(({ name }) => name === task);
    const set = run.data ?? found.data[0].name;
    const same = state.task === task && state.data === set && state.episode === episode;
    const other = state.task === task ? {} : { component: found.map.x };
    return {
      task,
      filter: run.filter,
      data: set,
      episode,
      faults,
      against: '',
      playing: false,
      angle: null,
      step: same ? state.step : 0,
      ...other,
    };
  }

  #show(files) {
    this.#rerun.files(files.map(({ name, url }) => ({ name, url })));
    this.#store.set({ tab: 'rerun', playing: false });
  }

  #choose(name) {
    if (!this.#chosen.delete(name)) this.#chosen.add(name);
    this.#drawChosen();
  }

  /** The files that are ticked, the first that was first. */
  get #two() {
    return [...this.#chosen]
      .map((name) => this.#kept.recordings.find((file) => file.name === name))
      .filter(Boolean);
  }

  /** What two files that are ticked can be compared by. */
  #drawChosen() {
    const files = this.#two;
    const host = this.#part('.chosen');
    host.hidden = !files.length;
    if (!files.length) return;
    const [text, both, compare, why] = host.children;
    text.textContent =
      files.length === 1 ? 'One chosen: choose another to compare.' : `${files.length} chosen.`;
    const unread =
      files.length !== 2
        ? 'Choose two.'
        : files.some(({ application }) => !application)
          ? 'One of them cannot be read.'
          : '';
    both.disabled = Boolean(unread);
    const cannot = unread || apart(...files);
    compare.disabled = Boolean(cannot);
    why.textContent = files.length === 2 ? cannot : '';
  }

  #compare() {
    const [one, other] = this.#two;
    this.#store.set({ ...this.#selection(one), against: against(one, other), tab: 'compare' });
  }

  #rename(file) {
    this.#recordings.edit(
      file,
      `New name of ${file.name}`,
      file.name.replace(/\.rrd$/, ''),
      async (text) => {
        const { name } = await api.changeRecording(file, { name: text });
        if (this.#chosen.delete(file.name)) this.#chosen.add(name);
        this.#point = name;
        await this.load();
      },
    );
  }

  #tag(file) {
    this.#recordings.edit(
      file,
      `Tags of ${file.name}, divided by commas`,
      file.tags.join(', '),
      async (text) => {
        await api.changeRecording(file, {
          tags: text
            .split(',')
            .map((tag) => tag.trim())
            .filter(Boolean),
        });
        await this.load();
      },
    );
  }

  #keep(file) {
    return this.#try(async () => {
      await api.changeRecording(file, { automatic: false });
      this.#point = file.name;
      return [`${file.name} is kept.`];
    });
  }

  async #delete(file, of) {
    await this.#try(async () => {
      const { deleted } = await api.deleteFile(file);
      return [
        `${file.name} is in the trash.`,
        () => this.#restore({ id: deleted, name: file.name, of }),
      ];
    });
    this.#part('.said button').focus();
  }

  #restore({ id, name, of }) {
    return this.#try(async () => {
      await api.restoreFile(of, id);
      this.#point = of === 'recordings' ? name : '';
      return [`${name} is back.`];
    });
  }

  async #empty() {
    this.#part('.sure').hidden = true;
    await this.#try(async () => {
      const freed = (await Promise.all(['recordings', 'reports'].map(api.emptyTrash))).reduce(
        (sum, one) => sum + one.freed,
        0,
      );
      return [`The trash is empty: ${formatBytes(freed)} are free again.`];
    });
  }

  /** Does it, asks what there is now, and says what was done, with what undoes it, or what went wrong. */
  async #try(act) {
    const said = await act().catch((error) => [error.message, null, true]);
    await this.load();
    if (said) this.#say(...said);
  }

  #say(text, undo = null, bad = false) {
    const line = this.#part('.said');
    this.#undo = undo;
    line.hidden = !text;
    line.dataset.state = bad ? 'error' : 'done';
    line.firstElementChild.textContent = text;
    line.querySelector('.text').hidden = !undo;
  }

  #drawTrash(trash) {
    const host = this.#part('.trash');
    host.hidden = !trash.length;
    const all = formatBytes(trash.reduce((sum, one) => sum + one.bytes, 0));
    host.querySelector('summary').textContent = `Deleted: ${trash.length}, ${all}`;
    const button = host.querySelector('.empty');
    [button.textContent, button.disabled, button.title] = [
      `Empty the trash (${all})`,
      Boolean(this.#readOnly),
      this.#readOnly ?? '',
    ];
    host.querySelector('ul').replaceChildren(
      ...trash.map((one) => {
        const line = document.createElement('li');
        const back = Object.assign(document.createElement('button'), {
          type: 'button',
          className: 'text quiet',
          textContent: 'Restore',
          ariaLabel: `Restore ${one.name}`,
          disabled: Boolean(this.#readOnly),
        });
        back.addEventListener('click', () => this.#restore(one));
        line.append(
          back,
          one.name,
          note(`${formatBytes(one.bytes)}, deleted ${moment(new Date(1000 * one.deleted))}`),
        );
        return line;
      }),
    );
  }

  #added({ name, problem, application }) {
    this.#say(problem ? `${name} is added. ${problem}` : `${name} is added.`);
    if (application) this.#point = name;
    this.load();
  }

  #add(files) {
    if (this.#readOnly) return this.#say(`${READ_ONLY}.`, null, true);
    const taken = new Set(this.#kept?.recordings.map(({ name }) => name));
    const free = (name) => {
      const [stem] = /^(.*?)(\.rrd)?$/s.exec(name).slice(1);
      let [wanted, number] = [`${stem}.rrd`, 2];
      while (taken.has(wanted)) wanted = `${stem}-${number++}.rrd`;
      taken.add(wanted);
      return wanted;
    };
    this.#adding.add([...files], free, this.#kept?.largest ?? Infinity);
  }

  #take() {
    const press = (selector, act) => this.#part(selector).addEventListener('click', act);
    const picker = this.#part('[type=file]');
    const field = this.#part('[type=search]');
    [this.#part('.add').disabled, this.#part('.add').title] = [
      Boolean(this.#readOnly),
      this.#readOnly ?? this.#part('.add').title,
    ];
    press('.add', () => picker.click());
    press('.both', () => this.#show(this.#two));
    press('.compare', () => this.#compare());
    press('.automatic button', () => ((this.#automatic = !this.#automatic), this.#draw()));
    press('.none', () => (this.#chosen.clear(), this.#draw()));
    press('.empty', () => ((this.#part('.sure').hidden = false), this.#part('.no').focus()));
    press('.yes', () => this.#empty());
    press('.no', () => ((this.#part('.sure').hidden = true), this.#part('.empty').focus()));
    press('.said .text', () => this.#undo?.());
    press('.said .quiet', () => this.#say(''));
    picker.addEventListener('change', () => (this.#add(picker.files), (picker.value = '')));
    field.addEventListener('input', () => this.#kept && this.#draw());
    field.addEventListener(
      'keydown',
      (event) => event.key === 'Escape' && this.#search(field.value.trim()),
    );
  }

  /** Files that are dragged here. A drag enters and leaves every element on its way. */
  #takeDrops() {
    const drop = this.#part('.drop');
    let inside = 0;
    const show = (by) => (drop.hidden = (inside = Math.max(0, inside + by)) === 0);
    const ours = (act) => (event) => {
      if (![...event.dataTransfer.types].includes('Files')) return;
      event.preventDefault();
      act(event);
    };
    this.#host.addEventListener(
      'dragenter',
      ours(() => show(1)),
    );
    this.#host.addEventListener(
      'dragover',
      ours(() => {}),
    );
    this.#host.addEventListener(
      'dragleave',
      ours(() => show(-1)),
    );
    this.#host.addEventListener(
      'drop',
      ours((event) => (show(-inside), this.#add(event.dataTransfer.files))),
    );
  }
}

/** Why two recordings' runs cannot be compared on the page; empty where they can. */
function apart(one, other) {
  const without = [one, other].find(({ run }) => !run);
  if (one.task !== other.task) return 'They are of different tasks.';
  if (without) return `${without.name}: ${without.why_not}`;
  if (one.episode !== other.episode || one.run.data !== other.run.data)
    return 'They are of different episodes: Rerun shows both.';
  return against(one, other) ? '' : 'They are of the same run.';
}

/** What differs in the other's run, as the page's address says it. */
function against(one, other) {
  const differs = {};
  if (one.run.filter !== other.run.filter) differs.filter = other.run.filter;
  if (one.faults !== other.faults) differs.faults = other.faults;
  return String(new URLSearchParams(differs));
}

/** The time of today, the day of any other. */
function moment(date) {
  const now = new Date();
  if (date.toDateString() === now.toDateString()) return TIME.format(date);
  return `${DAY.format(date)}${date.getFullYear() === now.getFullYear() ? '' : ` ${date.getFullYear()}`}`;
}

function note(text, kind = '') {
  return Object.assign(document.createElement('small'), { textContent: text, className: kind });
}
