/** Puts the page together: one state, one trace, and the panels that follow them. */

import * as api from '../data/api.js';
import { Camera } from '../scene/camera.js';
import { Clock } from './clock.js';
import { Compare } from '../tabs/comparison.js';
import { Diagnostics } from '../tabs/diagnostics.js';
import { Failures } from '../tabs/failures.js';
import { Finetune } from '../tabs/finetune.js';
import { Heatmaps } from '../maps/maps.js';
import { Jobs } from '../widgets/jobs.js';
import { keys } from './keys.js';
import { Library } from '../tabs/recordings.js';
import { Live, shelve } from '../tabs/live_runs.js';
import { mapTools } from '../maps/map_menu.js';
import { Numbers } from '../moment/step_table.js';
import { Theme, swatch, tellApart } from './palette.js';
import { Messages, say } from '../widgets/panel_state.js';
import { choice, pickers } from '../widgets/pickers.js';
import { reading } from '../moment/step_summary.js';
import { hold } from './read_only.js';
import { FaultSheet } from '../widgets/fault_dialog.js';
import { saving } from '../widgets/save_button.js';
import { ReportSheet } from '../widgets/report_dialog.js';
import { Rerun } from '../tabs/rerun.js';
import { SceneLook } from '../scene/scene_menu.js';
import { Slice } from '../maps/slice_slider.js';
import { ViewSocket } from '../data/view_socket.js';
import { Store, resolve } from './state.js';
import { Study } from '../tabs/study.js';
import { TimeLine } from '../timeline/timeline.js';
import { Undo } from './undo.js';
import { fixed, sentence, spoken } from './units.js';
import { Scene, tabs } from '../scene/tab_bar.js';

const $ = (selector) => document.querySelector(selector);
const KEPT = 1000; // latencies
const SCENE_WAITS = 1000; // ms at most until the scene starts, which would hold up everything else
const bodies = ['#heatmaps', '#moment .body', '#timeline .body'].map($);
const messages = new Messages($('#messages'));
const stats = { scrub: [], scene: [], maps: null, drawn: null, useful: null };
const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
let isUseful; // the page shows what it is for: the time line, and maps where there are any
const useful = new Promise((resolve) => (isUseful = () => requestAnimationFrame(resolve))).then(() => (stats.useful = performance.now()));

bodies.forEach((body) => say(body, 'loading', 'Loading …'));
start().catch((error) => {
  const line = error instanceof api.ServerError ? error.message : `The page failed: ${error.message}`;
  if (!(error instanceof api.ServerError)) console.error(error);
  bodies.forEach((body) => say(body, 'error', line));
  messages.say('start', line);
});

async function start() {
  const [catalog, live] = await Promise.all([api.catalog(), api.liveRuns().catch(() => ({ runs: [], tasks: [] }))]);
  shelve(catalog, live);
  messages.say('catalog', catalog.problems?.join(' '));
  $('#read-only').hidden = !catalog.read_only;
  if (catalog.read_only) hold(document.body);
  if (!catalog.tasks.length) {
    throw new api.ServerError('There is nothing to show: no task has both episodes and a trained filter.');
  }
  const { state, problems } = resolve(location.search, catalog);
  if (state.faults) await api.check({ ...state, against: '' }).catch((error) => {
    problems.push(`The link asks for sensors broken by “${state.faults}”: ${error.message}`);
    state.faults = '';
  });
  messages.say('link', problems.join('\n'));
  new Page(catalog, new Store(state), live);
}

/** Everything on the page, and what makes it move. */
class Page {
  #catalog;
  #store;
  #trace = null;
  #loading = new AbortController();
  #failed = false; // the last loading

  constructor(catalog, store, live) {
    [this.#catalog, this.#store] = [catalog, store];
    const sheet = new FaultSheet($('#fault-dialog'), catalog.faults);
    const listed = pickers(catalog, store, sheet);
    this.undo = new Undo(store);
    this.theme = new Theme((dark) => this.#recolour(dark));
    this.clock = new Clock(store);
    this.timeline = new TimeLine($('#timeline .body'), store);
    this.heatmaps = new Heatmaps($('#maps'), store, (moment) => this.socket.ask(moment));
    this.showMapTools = mapTools($('#maps-options'), $('#maps-view'), store, this.heatmaps);
    this.camera = new Camera($('#camera'));
    this.numbers = new Numbers($('#numbers'));
    this.slice = new Slice($('#slice-label'), $('#slice-true'), store);
    this.scene = new Scene($('#scene'));
    this.sceneLook = new SceneLook($('#scene'), store, (look) => this.socket.look(look), (at) => this.socket.stand(at));
    this.jobs = new Jobs($('#jobs'), $('#jobs-button'));
    this.rerun = new Rerun($('#rerun'), this.jobs, (step) => store.set({ step, playing: false }, { origin: 'rerun' }));
    this.diagnostics = new Diagnostics($('#diagnostics'), store, this.jobs);
    this.failures = new Failures($('#failures'), store, this.jobs, this.timeline, catalog);
    this.compare = new Compare($('#compare'), catalog, store, sheet, (other, name) => this.#overlay(other, name));
    this.finetune = new Finetune($('#finetune'), catalog, store, this.jobs, sheet);
    this.study = new Study($('#study'), catalog, store, this.failures, this.jobs);
    this.live = new Live(document, catalog, store, {
      grown: (trace, fresh) => this.#grow(trace, fresh),
      ended: (trace) => (this.timeline.grow(), this.diagnostics.show(trace), this.failures.show(trace)),
      listed,
      say: (line) => messages.say('live', line),
    }, live);
    this.library = new Library($('#recordings'), catalog, store, this.jobs, this.rerun);
    this.showTab = tabs(store);
    this.socket = new ViewSocket(this.#handlers(), () => this.theme.dark, () => this.sceneLook.look);
    this.save = saving($('#save'), $('#saved'), this.jobs, () => this.#trace && api.recorded(this.#trace), () => store.set({ tab: 'rerun' }), (name) => (store.set({ tab: 'recordings' }), this.library.point(name)));
    this.report = new ReportSheet($('#report'), () => ({ step: store.state.step, pinned: this.heatmaps.pinned }), (trace, wanted) => this.#report(trace, wanted));
    store.listen((state, changed) => this.#follow(state, changed));
    window.addEventListener('popstate', () => {
      const { state, problems } = resolve(location.search, catalog);
      messages.say('link', problems.join('\n'));
      store.stand(state);
    });
    this.#takeKeys();
    this.#takeButtons();
    this.#showTab(store.state.tab);
    this.#load();
    window.beliefscope = { state: () => ({ ...store.state }), stats, timeline: this.timeline, live: this.live, rerun: { getState: () => this.rerun.getState(), files: (files) => this.rerun.files(files) } };
  }

  /** Has a report written; its job becomes the link to it. */
  async #report({ selection }, wanted) {
    await api.report(selection, wanted);
    if ($('#jobs').hidden) this.jobs.toggle();
    else this.jobs.refresh();
  }

  /** The view's socket tells. */
  #handlers() {
    return {
      view: ({ scene }) => this.scene.open(scene, Promise.race([useful, pause(SCENE_WAITS)])),
      pace: (times) => this.scene.pace(times),
      maps: (maps, inputTime) => {
        if (!this.#trace) return;
        this.heatmaps.draw(maps, this.#trace, this.compare.name);
        say($('#heatmaps'), 'ready');
        stats.maps = { serial: maps.serial, step: maps.step, size: maps.size };
        if (inputTime !== null) keep(stats.scrub, performance.now() - inputTime);
        isUseful();
      },
      noMaps: (step, size) => {
        stats.maps = { step, size };
        isUseful();
      },
      drawn: (step, { inputTime }) => {
        this.scene.drawn();
        stats.drawn = { step };
        if (inputTime) keep(stats.scene, performance.now() - inputTime);
      },
      moved: (step) => this.#store.set({ step: this.#within(step), playing: false }, { origin: 'scene' }),
      error: (line) => messages.say('cursor', line),
      connection: (problem) => {
        messages.say('connection', problem);
        if (!problem && this.#failed) this.#load(); // the server is back
      },
    };
  }

  /** The state has changed: whatever depends on it is drawn in this frame. */
  #follow(state, changed) {
    const any = (...names) => names.some((name) => changed.has(name));
    if (any('task', 'filter', 'data', 'episode', 'faults')) this.#load();
    if (any('tab')) this.#showTab(state.tab);
    if (any('diagnostic', 'options', 'over')) this.diagnostics.choose();
    if (any('against') && this.#trace) this.compare.choose();
    if (any('task', 'filter', 'data', 'faults', 'among')) this.failures.load();
    else if (any('by', 'group', 'list')) this.failures.draw();
    if (any('task', 'filter', 'run')) this.finetune.load();
    if (any('playing')) this.#showPlaying(state.playing);
    if (!this.#trace) return;
    if (any('component', 'weights', 'track')) this.#choose();
    if (any('step', 'angle', 'beside')) this.#move();
  }

  /** Loads the trace that the state names and shows it in every panel. */
  async #load() {
    const { task: name, filter, data, episode, faults } = this.#store.state;
    this.#loading.abort();
    const loading = (this.#loading = new AbortController());
    [this.#trace, this.#failed] = [null, false];
    this.clock.show(null);
    const wait = (share) => bodies.forEach((body) => say(body, 'loading', 'Running the filter over the episode …', share));
    const patience = setTimeout(() => bodies.forEach((body) => say(body, 'loading', 'Loading …')), 150);
    const progress = (share) => (clearTimeout(patience), wait(share));
    try {
      const task = this.#catalog.tasks.find((t) => t.name === name);
      const selection = { task: name, filter, data, episode, faults };
      const trace = await api.loadTrace(task, selection, progress, loading.signal);
      clearTimeout(patience);
      this.#show(trace);
    } catch (error) {
      clearTimeout(patience);
      if (error.name === 'AbortError') return;
      if (!(error instanceof api.ServerError)) console.error(error);
      this.#failed = true;
      $('#reading').textContent = '';
      bodies.forEach((body) => say(body, 'error', error.message));
    }
  }

  #show(trace) {
    this.#trace = trace;
    this.live.show(trace);
    const { step } = this.#store.state;
    if (step >= trace.steps) {
      messages.say('step', `Step ${step} does not exist: this episode has steps 0 to ${trace.steps - 1}.`);
      this.#store.set({ step: trace.steps - 1 });
    }
    tellApart(trace.modalities);
    bodies.slice(1).forEach((body) => say(body, 'ready'));
    for (const panel of [this.clock, this.camera, this.timeline, this.slice, this.rerun, this.diagnostics, this.failures, this.report]) panel.show(trace);
    $('#maps-what').textContent = spoken(trace.task.map.x).replace(/(^| )x$/, '') || 'position';
    $('#maps').classList.toggle('one', !trace.fuses);
    $('#maps').classList.toggle('handless', !trace.has('effector_position'));
    $('#maps').classList.toggle('none', Boolean(trace.header.no_maps));
    if (trace.header.no_maps) say($('#heatmaps'), 'empty', sentence(trace.header.no_maps));
    $('#black-key').hidden = !trace.black.some(Boolean);
    $('#worst').disabled = !trace.truth(0).some(Number.isFinite);
    $('#swatches').replaceChildren(...['truth', ...trace.sources].flatMap((s) => [swatch(s), ` ${trace.called(s)}  `]));
    $('#sigma-key').hidden = !trace.has('estimate_sigma');
    this.showMapTools(trace);
    this.sceneLook.show(trace);
    this.compare.show(trace);
    this.#choose();
    this.#move();
  }

  /** A live run has more steps. Fresh: they tell of what was not known before. */
  #grow(trace, fresh) {
    if (fresh) return this.#show(trace);
    for (const panel of [this.clock, this.slice]) panel.show(trace);
    this.timeline.grow();
    $('#black-key').hidden = !trace.black.some(Boolean);
    this.#count();
  }

  /** The other run has come or gone: it is drawn over the time line, and in the scene. */
  #overlay(other, name) {
    this.timeline.against(other, name);
    if (this.#trace) this.#move(); // else another one is on its way
  }

  /** Another component, kind of weights or lowest chart. */
  #choose() {
    const [trace, { state }] = [this.#trace, this.#store];
    const set = (key) => (value) => this.#store.set({ [key]: value });
    choice($('#components'), trace.components.map((c) => [c.name, spoken(c.name)]), state.component, set('component'));
    choice($('#weights'), trace.has('weights') && trace.has('acting') ? [['raw', 'β raw'], ['acting', 'as it acted']] : [], state.weights, set('weights'));
    this.timeline.redraw();
    this.numbers.show(trace, state.component);
    this.numbers.move(state.step);
    this.#read(state);
  }

  #move() {
    const [trace, { state, origin, inputTime }] = [this.#trace, this.#store];
    const { step, angle } = state;
    for (const panel of [this.timeline, this.camera, this.numbers, this.slice, this.diagnostics, this.failures]) panel.move(step);
    this.compare.move(step);
    this.rerun.move(step, origin === 'rerun');
    this.socket.move({ ...trace.selection, step, angle, against: state.against, beside: state.beside === 'gain' }, inputTime);
    this.#read(state);
    this.#count();
  }

  #count() {
    const [{ steps, dt }, { step }] = [this.#trace, this.#store.state];
    const [count, time] = $('#readout').children;
    count.textContent = `${step} / ${steps - 1}`;
    time.textContent = `${fixed(step * dt)} s`;
  }

  #read({ step, component }) {
    const { tone, text } = reading(this.#trace, step, this.#trace.components.findIndex((c) => c.name === component));
    const line = $('#reading');
    line.dataset.tone = tone;
    line.textContent = line.title = text;
  }

  #within(step) {
    return Math.min(Math.max(step, 0), (this.#trace?.steps ?? 1) - 1);
  }

  #step(by, inputTime) {
    this.#store.set({ step: this.#within(this.#store.state.step + by), playing: false }, { inputTime });
  }

  #showTab(tab) {
    this.showTab(tab);
    this.rerun.open = tab === 'rerun';
    this.diagnostics.open = tab === 'diagnostics';
    this.failures.draw();
    this.compare.open = tab === 'compare';
    this.library.open = tab === 'recordings';
    this.finetune.open = tab === 'finetune';
    this.study.open = tab === 'study';
    if (this.#trace) this.rerun.move(this.#store.state.step, false);
  }

  #showPlaying(playing) {
    document.body.classList.toggle('playing', playing);
    $('#play').setAttribute('aria-label', playing ? 'Pause' : 'Play');
  }

  #recolour(dark) {
    this.socket.theme(dark);
    this.timeline.redraw();
    this.heatmaps.redraw();
    this.diagnostics.redraw();
    this.compare.redraw();
    this.finetune.redraw();
  }

  #goWorst() {
    if (this.#trace) this.#store.set({ step: this.timeline.worst(), playing: false }, { inputTime: performance.now() });
  }

  /** The edit of the other run begins, or ends, at the cursor. */
  #markEdit(end) {
    this.#store.set({ tab: 'compare' });
    this.compare.mark(end, this.#store.state.step);
  }

  #nextComponent() {
    const names = this.#trace?.components.map((c) => c.name) ?? [];
    const place = names.indexOf(this.#store.state.component);
    if (names.length) this.#store.set({ component: names[(place + 1) % names.length] });
  }

  #takeKeys() {
    const by = (steps) => (event) => this.#step(event.shiftKey ? 10 * steps : steps, event.timeStamp);
    keys({
      ' ': () => this.clock.toggle(),
      ArrowLeft: by(-1),
      ArrowRight: by(1),
      PageUp: (event) => this.#step(this.timeline.tenth, event.timeStamp),
      PageDown: (event) => this.#step(-this.timeline.tenth, event.timeStamp),
      Home: (event) => this.#step(-Infinity, event.timeStamp),
      End: (event) => this.#step(Infinity, event.timeStamp),
      '<': () => this.clock.changeSpeed(-1),
      '>': () => this.clock.changeSpeed(1),
      '[': () => this.#markEdit('from'),
      ']': () => this.#markEdit('last'),
      o: () => this.#store.set({ tab: 'compare' }),
      'ctrl+z': () => this.undo.undo(),
      'ctrl+shift+z': () => this.undo.redo(),
      'ctrl+y': () => this.undo.redo(),
      '+': () => this.timeline.zoom(0.5),
      '=': () => this.timeline.zoom(0.5),
      '-': () => this.timeline.zoom(2),
      0: () => this.timeline.whole(),
      1: () => this.#store.set({ tab: 'scene' }),
      2: () => this.#store.set({ tab: 'rerun' }),
      3: () => this.#store.set({ tab: 'diagnostics' }),
      f: () => this.#store.set({ tab: 'failures' }),
      n: (event) => this.failures.go(1, event.timeStamp),
      b: (event) => this.failures.go(-1, event.timeStamp),
      t: () => this.#store.set({ tab: 'finetune' }),
      u: () => this.#store.set({ tab: 'study' }),
      r: () => this.#store.set({ tab: 'recordings' }),
      j: () => this.jobs.toggle(),
      c: () => this.#nextComponent(),
      e: () => this.#goWorst(),
      l: () => this.live.newest(),
      m: () => this.heatmaps.pin(),
      s: () => this.save(),
      d: () => this.theme.toggle(),
      '?': () => $('#keys').showModal(),
    });
  }

  #takeButtons() {
    const press = (selector, action) => $(selector).addEventListener('click', action);
    press('#play', () => this.clock.toggle());
    press('#back', (event) => this.#step(-1, event.timeStamp));
    press('#forward', (event) => this.#step(1, event.timeStamp));
    press('#dark', () => this.theme.toggle());
    press('#help', () => $('#keys').showModal());
    press('#whole', () => this.timeline.whole());
    press('#worst', () => this.#goWorst());
    for (const selector of ['#heatmaps', '#camera']) {
      const turn = (event) => (event.preventDefault(), this.#step(Math.sign(event.deltaY || event.deltaX), event.timeStamp));
      $(selector).addEventListener('wheel', turn, { passive: false });
    }
  }
}

function keep(list, value) {
  list.push(value);
  if (list.length > KEPT) list.shift();
}
