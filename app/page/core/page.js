/** The page: its panels, tabs and commands. */

/** @import { LiveList, Selection } from '../types/server.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { Tabs } from '../tabs/tabs.js' */
/** @import { Messages } from '../widgets/panel_state.js' */
/** @import { Layout } from './layouts.js' */
/** @import { Store } from './state.js' */

import * as api from '../data/api.js';
import { ViewSocket } from '../data/view_socket.js';
import { AngleSlider } from '../maps/angle_slider.js';
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
import { showFullText } from '../widgets/full_text.js';
import { Intro } from '../widgets/intro.js';
import { Jobs } from '../widgets/jobs.js';
import { setPanelError, setPanelState } from '../widgets/panel_state.js';
import { connectPickers } from '../widgets/pickers.js';
import { ReportDialog } from '../widgets/report_dialog.js';
import { connectSaveButton } from '../widgets/save_button.js';
import { Tour } from '../widgets/tour.js';
import { copyText } from './clipboard.js';
import { Clock } from './clock.js';
import { commands, episodeCommands, stepCommand } from './commands.js';
import { bindControls } from './controls.js';
import { useful } from './common_panels.js';
import { DisplayedRun, delayed } from './displayed_run.js';
import { element, html, messageOf } from './dom.js';
import { layoutMenu } from './layouts.js';
import { Splitters } from './splitters.js';
import { parsePermalink, permalink } from './state.js';
import { stats } from './measurements.js';
import { tabBar } from './tab_bar.js';
import { Theme } from './theme.js';
import { Undo } from './undo.js';

const NOTICE_TIME = 3000; // ms

export class Page {
  #store;
  #messages;
  #run;
  #faultDialog;
  /** @type {Promise<Tabs | null> | null} */
  #loadingTabs = null;
  /** Null until the run is displayed. @type {Tabs | null} */
  tabs = null;

  /**
   * @param {Store} store
   * @param {LiveList} live
   * @param {Messages} messages
   */
  constructor(store, live, messages) {
    this.#store = store;
    this.#messages = messages;
    this.#run = new DisplayedRun(this, store, messages);
    this.#faultDialog = new FaultDialog(
      element('#fault-dialog', HTMLDialogElement),
      store.catalog.faults,
      () => this.#run.trace?.steps ?? null,
    );
    const refreshPickers = connectPickers(store, this.#faultDialog, () =>
      this.commands.toggle('episode '),
    );
    this.finding = new FindingBar(html('#finding'), store);
    this.intro = new Intro(html('#intro'), store, () => this.tour.start());
    this.tour = new Tour();
    this.splitters = new Splitters();
    layoutMenu(html('#layouts'), html('#layout'), (layout) => this.setLayout(layout));
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
    this.live = new Live(store, this.#run.liveHandlers(refreshPickers), live);
    this.selectTab = tabBar(store);
    this.socket = new ViewSocket(
      this.#run.socketHandlers,
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
      (/** @type {string} */ query) => episodeCommands(store, query),
    );
    this.#start();
  }

  #start() {
    const store = this.#store;
    store.listen((state, changed) => this.#run.follow(state, changed));
    window.addEventListener('popstate', () => {
      const { state, problems } = parsePermalink(location.search, this.#store.catalog);
      this.#messages.show('link', problems.join('\n'));
      store.restore(state);
    });
    bindControls(this);
    for (const selector of ['#finding .sentence', '#step-summary']) showFullText(html(selector));
    this.showTab(store.state.tab);
    this.#run.load();
    Promise.race([useful, delayed]).then(() => this.loadTabs());
    const { timeline, live } = this;
    window.beliefscope = {
      state: () => ({ ...store.state }),
      stats,
      timeline,
      live,
      rerun: {
        getState: async () => (await this.loadTabs())?.rerun.getState(),
        files: async (files) => (await this.loadTabs())?.rerun.files(files),
      },
    };
  }

  /** Loads the tabs, once. They are a third of the page, and the run is readable without them. */
  loadTabs() {
    this.#loadingTabs ??= this.#createTabs().catch((error) => {
      this.#loadingTabs = null;
      const reason = `The tabs cannot be loaded: ${messageOf(error)}`;
      setPanelError(html('#tabs-state'), reason, () => this.loadTabs());
      return null;
    });
    return this.#loadingTabs;
  }

  async #createTabs() {
    setPanelState(html('#tabs-state'), 'loading', 'Loading …');
    const { Tabs } = await import('../tabs/tabs.js');
    const tabs = new Tabs(this.#store, {
      jobs: this.jobs,
      timeline: this.timeline,
      finding: this.finding,
      faultDialog: this.#faultDialog,
      reload: () => this.#run.load(),
      setComparison: (trace, name) => this.#run.setComparison(trace, name),
    });
    this.tabs = tabs;
    document.documentElement.classList.add('with-tabs');
    tabs.open(this.#store.state.tab);
    const { trace, failure } = this.#run;
    if (failure) tabs.fail(failure);
    if (!trace) return tabs;
    tabs.show(trace);
    tabs.move(this.#store.state.step, false);
    return tabs;
  }

  #bindSaveButton() {
    const button = element('#save', HTMLButtonElement);
    return connectSaveButton(button, html('#save-status'), this.jobs, {
      request: () => {
        const { trace } = this.#run;
        return trace && api.recordingRequest(trace, this.#store.state.map);
      },
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

  /** @param {string} tab */
  showTab(tab) {
    this.selectTab(tab);
    this.tabs?.open(tab);
    if (this.#run.trace) this.tabs?.rerun.move(this.#store.state.step, false);
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
    return Math.min(Math.max(step, 0), (this.#run.trace?.steps ?? 1) - 1);
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

  /** @param {Layout} layout */
  setLayout({ sizes, tab }) {
    this.splitters.set(sizes);
    this.openTab(tab);
  }

  /**
   * Goes to the next or the previous failure, and announces a change of the episode.
   * @param {1 | -1} by
   * @param {number} inputTime
   */
  goToFailure(by, inputTime) {
    this.#messages.show('failure', this.tabs?.failures.go(by, inputTime));
  }

  goToLargestError() {
    if (this.#run.trace) this.goTo(this.timeline.largestError);
  }

  /**
   * Lets the intervention begin at the cursor, or end after it.
   * @param {'from' | 'to'} end
   */
  markIntervention(end) {
    this.openTab('compare');
    this.tabs?.compare.mark(end, this.#store.state.step);
  }

  /** Copies a link to the displayed step. */
  async copyLink() {
    const { state } = this.#store;
    const success = await copyText(new URL(permalink(state), location.href).href);
    const text = success ? `Link to step ${state.step} copied` : 'Copy the address of the page';
    this.#messages.show('link', text);
    setTimeout(() => this.#messages.show('link'), NOTICE_TIME);
  }

  selectNextComponent() {
    const names = this.#run.trace?.components.map(({ name }) => name) ?? [];
    const index = names.indexOf(this.#store.state.component);
    if (names.length) this.#store.set({ component: names[(index + 1) % names.length] });
  }

  switchTimeAxis() {
    this.#store.set({ time: this.#store.state.time === 'steps' ? 'seconds' : 'steps' });
  }
}
