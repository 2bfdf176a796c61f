/** The page: its panels, which follow the state and the displayed trace. */

/** @import { Catalog, LiveList, Selection } from '../data/api.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { Handlers } from '../data/view_socket.js' */
/** @import { Tabs } from '../tabs/tabs.js' */
/** @import { Messages } from '../widgets/panel_state.js' */
/** @import { State, Store } from './state.js' */

import * as api from '../data/api.js';
import { ViewSocket } from '../data/view_socket.js';
import { AngleSlider } from '../maps/angle_slider.js';
import { mapChoices } from '../maps/map_choices.js';
import { mapMenu } from '../maps/map_menu.js';
import { MapPanel } from '../maps/map_panel.js';
import { Camera } from '../scene/camera.js';
import { SceneFrame } from '../scene/scene_frame.js';
import { SceneMenu } from '../scene/scene_menu.js';
import { StepTable } from '../step/step_table.js';
import { Live } from '../tabs/live_runs.js';
import { Timeline } from '../timeline/timeline.js';
import { CommandPalette } from '../widgets/command_palette.js';
import { FaultDialog } from '../widgets/fault_dialog.js';
import { FindingBar } from '../widgets/finding_bar.js';
import { Intro } from '../widgets/intro.js';
import { Jobs } from '../widgets/jobs.js';
import { setPanelError, setPanelState } from '../widgets/panel_state.js';
import { choice, connectPickers } from '../widgets/pickers.js';
import { ReportDialog } from '../widgets/report_dialog.js';
import { connectSaveButton } from '../widgets/save_button.js';
import { Tour } from '../widgets/tour.js';
import { Clock } from './clock.js';
import { commands, episodeCommands, stepCommand } from './commands.js';
import { bindControls } from './controls.js';
import {
  markUseful,
  showBlackouts,
  showCount,
  showError,
  showProperties,
  showSummary,
  startLoading,
  useful,
} from './common_panels.js';
import { element, html, messageOf } from './dom.js';
import { layoutMenu, layoutSetter } from './layouts.js';
import { assignSpareColours } from './colours.js';
import { Splitters } from './splitters.js';
import { parsePermalink } from './state.js';
import { addLatency, stats } from './measurements.js';
import { tabBar } from './tab_bar.js';
import { Theme } from './theme.js';
import { Undo } from './undo.js';
import { displayName } from './units.js';

const MAX_DELAY = 1000; // ms until tabs and 3D scene load, which would slow down the other panels

const delayed = new Promise((resolve) => setTimeout(resolve, MAX_DELAY));

export class Page {
  #catalog;
  #store;
  #messages;
  /** @type {Trace | null} */
  #trace = null;
  #loading = new AbortController();
  #failure = ''; // why the last trace could not be loaded
  #faultDialog;
  /** @type {Promise<Tabs | null> | null} */
  #loadingTabs = null;
  /** Null until the run is displayed. @type {Tabs | null} */
  tabs = null;

  /**
   * @param {Catalog} catalog
   * @param {Store} store
   * @param {LiveList} live
   * @param {Messages} messages
   */
  constructor(catalog, store, live, messages) {
    this.#catalog = catalog;
    this.#store = store;
    this.#messages = messages;
    this.#faultDialog = new FaultDialog(
      element('#fault-dialog', HTMLDialogElement),
      catalog.faults,
    );
    const refreshPickers = connectPickers(catalog, store, this.#faultDialog, () =>
      this.commands.toggle('episode '),
    );
    this.finding = new FindingBar(html('#finding'), store);
    this.intro = new Intro(html('#intro'), catalog, store, () => this.tour.start());
    this.tour = new Tour();
    this.splitters = new Splitters();
    this.setLayout = layoutSetter(store, this.splitters);
    layoutMenu(html('#layouts'), html('#layout'), this.setLayout);
    this.undo = new Undo(store);
    this.theme = new Theme((dark) => this.#changeTheme(dark));
    this.clock = new Clock(store);
    this.timeline = new Timeline(html('#timeline .body'), store);
    this.maps = new MapPanel(html('#maps'), store, (cursor, size) =>
      this.socket.requestMaps(cursor, size),
    );
    this.adaptMapMenu = mapMenu(html('#maps-options'), html('#maps-view'), store, this.maps);
    this.camera = new Camera(html('#camera'), store);
    this.stepTable = new StepTable(html('#step-table'));
    this.angleSlider = new AngleSlider(
      html('#angle-label'),
      element('#angle-reset', HTMLButtonElement),
      store,
    );
    this.scene = new SceneFrame(html('#scene'));
    this.sceneMenu = new SceneMenu(
      html('#scene'),
      store,
      (options) => this.socket.setScene(options),
      (at) => this.socket.setViewpoint(at),
    );
    this.jobs = new Jobs(html('#jobs'), element('#jobs-button', HTMLButtonElement));
    this.live = new Live(catalog, store, this.#liveHandlers(refreshPickers), live);
    this.selectTab = tabBar(store);
    this.socket = new ViewSocket(
      this.#socketHandlers(),
      () => this.theme.dark,
      () => this.sceneMenu.options,
    );
    this.save = this.#bindSaveButton();
    this.report = new ReportDialog(
      element('#report', HTMLButtonElement),
      () => ({ step: store.state.step, pinned: this.maps.pinned }),
      (/** @type {Trace} */ trace, /** @type {api.ReportOptions} */ options) =>
        this.#createReport(trace.selection, options),
    );
    this.commands = new CommandPalette(
      element('#commands', HTMLDialogElement),
      () => commands(this),
      (/** @type {string} */ query) => stepCommand(this, query),
      (/** @type {string} */ query) => episodeCommands(catalog, store, query),
    );
    this.#start();
  }

  #start() {
    const store = this.#store;
    store.listen((state, changed) => this.#follow(state, changed));
    window.addEventListener('popstate', () => {
      const { state, problems } = parsePermalink(location.search, this.#catalog);
      this.#messages.show('link', problems.join('\n'));
      store.restore(state);
    });
    bindControls(this);
    this.#showTab(store.state.tab);
    this.#load();
    Promise.race([useful, delayed]).then(() => this.#loadTabs());
    const { timeline, live } = this;
    window.beliefscope = {
      state: () => ({ ...store.state }),
      stats,
      timeline,
      live,
      rerun: {
        getState: async () => (await this.#loadTabs())?.rerun.getState(),
        files: async (files) => (await this.#loadTabs())?.rerun.files(files),
      },
    };
  }

  /** Loads the tabs, once. They are a third of the page, and the run is readable without them. */
  #loadTabs() {
    this.#loadingTabs ??= this.#createTabs().catch((error) => {
      this.#loadingTabs = null;
      const reason = `The tabs cannot be loaded: ${messageOf(error)}`;
      setPanelError(html('#tabs-state'), reason, () => this.#loadTabs());
      return null;
    });
    return this.#loadingTabs;
  }

  async #createTabs() {
    setPanelState(html('#tabs-state'), 'loading', 'Loading …');
    const { Tabs } = await import('../tabs/tabs.js');
    const tabs = new Tabs(this.#catalog, this.#store, {
      jobs: this.jobs,
      timeline: this.timeline,
      finding: this.finding,
      faultDialog: this.#faultDialog,
      reload: () => this.#load(),
      setComparison: (trace, name) => this.#setComparison(trace, name),
    });
    this.tabs = tabs;
    document.documentElement.classList.add('with-tabs');
    tabs.open(this.#store.state.tab);
    if (this.#failure) tabs.diagnosis.fail(this.#failure);
    if (!this.#trace) return tabs;
    tabs.show(this.#trace);
    tabs.move(this.#store.state.step, false);
    return tabs;
  }

  #bindSaveButton() {
    const button = element('#save', HTMLButtonElement);
    return connectSaveButton(button, html('#save-status'), this.jobs, {
      request: () => this.#trace && api.recordingRequest(this.#trace, this.#store.state.map),
      openRerun: () => this.openTab('rerun'),
      openRecordings: (name) => {
        this.openTab('recordings');
        this.tabs?.recordings.point(name);
      },
    });
  }

  /**
   * Starts a job that writes a report, and shows the list of jobs.
   * @param {Selection} selection
   * @param {api.ReportOptions} options
   */
  async #createReport(selection, options) {
    await api.createReport(selection, { ...options, quantity: this.#store.state.map });
    if (html('#jobs').hidden) this.jobs.toggle();
    else this.jobs.refresh();
  }

  /** @param {() => void} refreshPickers */
  #liveHandlers(refreshPickers) {
    return {
      grown: (/** @type {Trace} */ trace, /** @type {boolean} */ hasNewColumns) =>
        this.#grow(trace, hasNewColumns),
      ended: (/** @type {Trace} */ trace) => {
        this.timeline.grow();
        this.tabs?.diagnostics.show(trace);
        this.tabs?.failures.show(trace);
      },
      listed: refreshPickers,
      message: (/** @type {string} */ text) => this.#messages.show('live', text),
    };
  }

  /** @returns {Handlers} */
  #socketHandlers() {
    return {
      view: ({ scene }) => {
        const others = useful.then(() => this.#loadTabs());
        this.scene.open(scene, Promise.race([others, delayed]));
      },
      pace: (factor) => this.scene.pace(factor),
      maps: (maps, inputTime) => {
        if (!this.#trace) return;
        this.maps.draw(maps, this.#trace, this.tabs?.compare.name);
        setPanelState(html('#heatmaps'), 'ready');
        stats.maps = { serial: maps.serial, step: maps.step, size: maps.size };
        if (inputTime !== null) addLatency(stats.scrub, performance.now() - inputTime);
        markUseful();
      },
      noMaps: (step, size) => {
        stats.maps = { step, size };
        markUseful();
      },
      drawn: (step, inputTime) => {
        this.scene.drawn(this.#trace?.header.scene ?? []);
        stats.drawn = { step };
        if (inputTime !== null) addLatency(stats.scene, performance.now() - inputTime);
      },
      error: (line) => this.#messages.show('cursor', line),
      connection: (problem) => {
        this.#messages.show('connection', problem ?? '');
        if (!problem && this.#failure) this.#load();
      },
    };
  }

  /**
   * Updates everything that depends on the changed keys of the state.
   * @param {State} state
   * @param {Set<string>} changed
   */
  #follow(state, changed) {
    /** @param {...string} keys */
    const any = (...keys) => keys.some((key) => changed.has(key));
    if (any('task', 'filter', 'data', 'episode', 'faults')) this.#load();
    if (any('tab')) this.#showTab(state.tab);
    this.tabs?.follow(changed, Boolean(this.#trace));
    if (any('playing')) this.#showPlaying(state.playing);
    if (!this.#trace) return;
    if (any('component', 'weights', 'track', 'charts', 'time')) this.#showComponent(this.#trace);
    if (any('plane', 'others')) this.angleSlider.show(this.#trace);
    if (any('step', 'angle', 'beside', 'map', 'plane', 'others')) this.#move(this.#trace);
  }

  /** Loads the trace that the state selects. */
  async #load() {
    const { task: name, filter, data, episode, faults } = this.#store.state;
    const task = this.#catalog.tasks.find((item) => item.name === name);
    if (!task) return;
    this.#loading.abort();
    const loading = (this.#loading = new AbortController());
    [this.#trace, this.#failure] = [null, ''];
    this.clock.show(null);
    this.scene.failure = '';
    this.tabs?.diagnosis.show(null);
    this.finding.show(null);
    const loadingState = startLoading();
    try {
      const selection = { task: name, filter, data, episode, faults };
      const trace = await api.loadTrace(task, selection, loadingState.progress, loading.signal);
      loadingState.stop();
      this.#show(trace);
    } catch (error) {
      loadingState.stop();
      if (loading.signal.aborted) return;
      document.documentElement.classList.add('started');
      const text = showError(error);
      this.#failure = this.scene.failure = text;
      this.finding.fail(text, () => this.#load());
      this.tabs?.diagnosis.fail(text);
    }
  }

  /** @param {Trace} trace */
  #show(trace) {
    this.#trace = trace;
    this.live.show(trace);
    const { step } = this.#store.state;
    if (step >= trace.steps) {
      const range = `0 to ${trace.steps - 1}`;
      this.#messages.show('step', `Step ${step} does not exist. The steps are ${range}.`);
      this.#store.set({ step: trace.steps - 1 });
    }
    assignSpareColours(trace.modalities);
    this.clock.show(trace);
    this.camera.show(trace);
    this.timeline.show(trace);
    this.angleSlider.show(trace);
    this.report.show(trace);
    this.finding.show(trace);
    showProperties(trace);
    this.adaptMapMenu(trace);
    this.sceneMenu.show(trace);
    this.tabs?.show(trace);
    this.#showComponent(trace);
    this.#move(trace);
    document.documentElement.classList.add('started');
  }

  /**
   * Displays the new steps of a live run.
   * @param {Trace} trace
   * @param {boolean} hasNewColumns
   */
  #grow(trace, hasNewColumns) {
    if (hasNewColumns) {
      this.#show(trace);
      return;
    }
    this.clock.show(trace);
    this.angleSlider.show(trace);
    this.timeline.grow();
    showBlackouts(trace);
    showCount(trace, this.#store.state.step);
  }

  /**
   * Displays a comparison run in the timeline and in the scene, or removes it.
   * @param {Trace | null} trace
   * @param {string} name
   */
  #setComparison(trace, name) {
    const changed = this.timeline.compareWith(trace, name);
    if (this.#trace && changed) this.#move(this.#trace);
  }

  /**
   * Displays the selected component, kind of weights and lowest chart.
   * @param {Trace} trace
   */
  #showComponent(trace) {
    const { state } = this.#store;
    choice(
      html('#components'),
      trace.components.map(({ name }) => [name, displayName(name)]),
      state.component,
      (component) => this.#store.set({ component }),
    );
    const hasBoth = trace.has('weights') && trace.has('effective_weights');
    choice(
      html('#weights'),
      hasBoth
        ? [
            ['raw', 'fusion β'],
            ['effective', 'effective'],
          ]
        : [],
      state.weights,
      (weights) => this.#store.set({ weights }),
    );
    this.timeline.redraw();
    this.stepTable.show(trace, state.component);
    this.stepTable.move(state.step);
    showSummary(trace, state.step, state.component);
  }

  /** @param {Trace} trace */
  #move(trace) {
    const { state, origin, inputTime } = this.#store;
    const { step, angle, against } = state;
    this.timeline.move(step);
    this.camera.move(step);
    this.stepTable.move(step);
    this.angleSlider.move(step);
    this.tabs?.move(step, origin === 'rerun');
    const cursor = { ...trace.selection, step, angle, against, ...mapChoices(state, trace) };
    this.socket.move({ ...cursor, comparison_maps: state.beside === 'gain' }, inputTime);
    showSummary(trace, step, state.component);
    showCount(trace, step);
  }

  /** @param {string} tab */
  #showTab(tab) {
    this.selectTab(tab);
    this.tabs?.open(tab);
    if (this.#trace) this.tabs?.rerun.move(this.#store.state.step, false);
  }

  /** @param {boolean} playing */
  #showPlaying(playing) {
    document.body.classList.toggle('playing', playing);
    html('#play').ariaLabel = playing ? 'Pause' : 'Play';
  }

  /** @param {boolean} dark */
  #changeTheme(dark) {
    this.socket.setTheme(dark);
    this.timeline.redraw();
    this.maps.redraw();
    this.tabs?.redraw();
  }

  /** @param {number} step */
  #clamp(step) {
    return Math.min(Math.max(step, 0), (this.#trace?.steps ?? 1) - 1);
  }

  /**
   * Moves the cursor by a number of steps.
   * @param {number} steps
   * @param {number} inputTime
   */
  stepBy(steps, inputTime) {
    const step = this.#clamp(this.#store.state.step + steps);
    this.#store.set({ step, playing: false }, { inputTime });
  }

  /** @param {number} step */
  goTo(step) {
    const inputTime = performance.now();
    this.#store.set({ step: this.#clamp(step), playing: false }, { inputTime });
  }

  /** @param {string} tab */
  openTab(tab) {
    this.#store.set({ tab });
  }

  goToLargestError() {
    if (this.#trace) this.goTo(this.timeline.largestError);
  }

  /**
   * Sets the first or the last step of the intervention to the cursor.
   * @param {'from' | 'last'} end
   */
  markIntervention(end) {
    this.openTab('compare');
    this.tabs?.compare.mark(end, this.#store.state.step);
  }

  selectNextComponent() {
    const names = this.#trace?.components.map(({ name }) => name) ?? [];
    const index = names.indexOf(this.#store.state.component);
    if (names.length) this.#store.set({ component: names[(index + 1) % names.length] });
  }

  switchTimeAxis() {
    this.#store.set({ time: this.#store.state.time === 'steps' ? 'seconds' : 'steps' });
  }
}
