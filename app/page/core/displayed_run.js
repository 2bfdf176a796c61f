/** The displayed run: its trace, which follows the selection in the state, and the panels, which follow both. */

/** @import { Trace } from '../data/trace.js' */
/** @import { Curve } from '../types/server.js' */
/** @import { Handlers } from '../data/view_socket.js' */
/** @import { Messages } from '../widgets/panel_state.js' */
/** @import { Page } from './page.js' */
/** @import { State, Store } from './state.js' */

import * as api from '../data/api.js';
import { mapChoices } from '../maps/map_choices.js';
import { loadErrorSources } from '../step/error_sources.js';
import { setPanelState } from '../widgets/panel_state.js';
import { choice } from '../widgets/pickers.js';
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
import { assignSpareColours } from './colours.js';
import { html, pause } from './dom.js';
import { addLatency, stats } from './measurements.js';
import { displayName } from './units.js';

const MAX_DELAY = 1000; // ms until tabs and 3D scene load, which would slow down the other panels

export const delayed = pause(MAX_DELAY);

export class DisplayedRun {
  #page;
  #store;
  #messages;
  #loading = new AbortController();
  /** @type {Trace | null} */
  trace = null;
  failure = ''; // why the last trace could not be loaded
  /** @type {Curve[]} */
  #errorSources = [];

  /**
   * @param {Page} page
   * @param {Store} store
   * @param {Messages} messages
   */
  constructor(page, store, messages) {
    this.#page = page;
    this.#store = store;
    this.#messages = messages;
  }

  /**
   * Updates everything that depends on the changed keys of the state.
   * @param {State} state
   * @param {Set<string>} changed
   */
  follow(state, changed) {
    const page = this.#page;
    /** @param {...string} keys */
    const any = (...keys) => keys.some((key) => changed.has(key));
    if (any('task', 'filter', 'data', 'episode', 'faults')) this.load();
    if (any('tab')) page.showTab(state.tab);
    page.tabs?.follow(changed, Boolean(this.trace));
    if (any('playing')) showPlaying(state.playing);
    if (!this.trace) return;
    if (any('component', 'weights', 'track', 'charts', 'time')) this.#showComponent(this.trace);
    if (any('plane', 'others')) page.angleSlider.show(this.trace);
    if (any('step', 'angle', 'beside', 'map', 'plane', 'others')) this.#move(this.trace);
  }

  /** Loads the trace that the state selects. */
  async load() {
    const page = this.#page;
    const { task: name, filter, data, episode, faults } = this.#store.state;
    const task = this.#store.task();
    if (!task) return;
    this.#loading.abort();
    const loading = (this.#loading = new AbortController());
    [this.trace, this.failure, this.#errorSources] = [null, '', []];
    page.clock.show(null);
    page.scene.failure = '';
    page.tabs?.diagnosis.show(null);
    page.finding.show(null);
    const loadingState = startLoading();
    try {
      const selection = { task: name, filter, data, episode, faults };
      const trace = await api.loadTrace(task, selection, loadingState.progress, loading.signal);
      loadingState.stop();
      this.#show(trace);
      this.#loadErrorSources(trace, loading.signal);
    } catch (error) {
      loadingState.stop();
      if (loading.signal.aborted) return;
      document.documentElement.classList.add('started');
      const text = showError(error);
      this.failure = page.scene.failure = text;
      page.finding.fail(text, () => this.load());
      page.tabs?.fail(text);
    }
  }

  /** @param {Trace} trace */
  #show(trace) {
    const page = this.#page;
    this.trace = trace;
    page.live.show(trace);
    const { step } = this.#store.state;
    if (step >= trace.steps) {
      const range = `0 to ${trace.steps - 1}`;
      this.#messages.show('step', `Step ${step} does not exist. The steps are ${range}.`);
      this.#store.set({ step: trace.steps - 1 });
    }
    assignSpareColours(trace.modalities);
    page.clock.show(trace);
    page.camera.show(trace);
    page.timeline.show(trace);
    page.angleSlider.show(trace);
    page.report.show(trace);
    page.finding.show(trace);
    if (this.#store.state.atFinding)
      this.#store.set({ step: page.finding.step ?? 0, atFinding: false });
    showProperties(trace);
    page.adaptMapMenu(trace);
    page.sceneMenu.show(trace);
    page.tabs?.show(trace);
    this.#leaveEmptyScene(trace);
    this.#showComponent(trace);
    this.#move(trace);
    document.documentElement.classList.add('started');
  }

  /**
   * Adds the sources of the error to the summary of the step, after what the page displays first.
   * @param {Trace} trace
   * @param {AbortSignal} signal
   */
  async #loadErrorSources(trace, signal) {
    await Promise.race([useful, delayed]);
    const sources = signal.aborted ? [] : await loadErrorSources(trace, signal).catch(() => []);
    if (signal.aborted) return;
    this.#errorSources = sources;
    this.#showSummary(trace);
  }

  /** @param {Trace} trace */
  #showSummary(trace) {
    const { step, component } = this.#store.state;
    showSummary(trace, step, component, this.#errorSources);
  }

  /**
   * Opens another tab than the scene if the task of a new run has none.
   * @param {Trace} trace
   */
  #leaveEmptyScene(trace) {
    if (this.#store.state.tab === 'scene' && trace.header.scene?.length === 0)
      this.#store.set({ tab: 'diagnosis' });
  }

  /**
   * Displays the new steps of a live run.
   * @param {Trace} trace
   * @param {boolean} hasNewColumns
   */
  #grow(trace, hasNewColumns) {
    const page = this.#page;
    if (hasNewColumns) {
      this.#show(trace);
      return;
    }
    page.clock.show(trace);
    page.angleSlider.show(trace);
    page.timeline.grow();
    showBlackouts(trace);
    showCount(trace, this.#store.state.step);
  }

  /**
   * Displays a comparison run in the timeline and in the scene, or removes it.
   * @param {Trace | null} trace
   * @param {string} name
   */
  setComparison(trace, name) {
    const changed = this.#page.timeline.compareWith(trace, name);
    if (this.trace && changed) this.#move(this.trace);
  }

  /**
   * Displays the selected component, kind of weights and lowest chart.
   * @param {Trace} trace
   */
  #showComponent(trace) {
    const page = this.#page;
    const { state } = this.#store;
    choice(
      html('#components'),
      trace.components.map(({ name }) => [name, displayName(name)]),
      state.component,
      (component) => this.#store.set({ component }),
    );
    const hasBoth = trace.has('weights') && trace.has('effective_weights');
    /** @type {Record<string, string>} */
    const kinds = hasBoth ? { raw: 'fusion β', effective: 'effective' } : {};
    choice(html('#weights'), kinds, state.weights, (weights) => this.#store.set({ weights }));
    page.timeline.redraw();
    page.stepTable.show(trace, state.component);
    page.stepTable.move(state.step);
    this.#showSummary(trace);
  }

  /** @param {Trace} trace */
  #move(trace) {
    const page = this.#page;
    const { state, origin, inputTime } = this.#store;
    const { step, angle, against } = state;
    page.timeline.move(step);
    page.camera.move(step);
    page.stepTable.move(step);
    page.angleSlider.move(step);
    page.tabs?.move(step, origin === 'rerun');
    const cursor = { ...trace.selection, step, angle, against, ...mapChoices(state, trace) };
    page.socket.move({ ...cursor, comparison_maps: state.beside === 'gain' }, inputTime);
    this.#showSummary(trace);
    showCount(trace, step);
  }

  /** @returns {Handlers} */
  get socketHandlers() {
    const page = this.#page;
    return {
      view: ({ scene }) => {
        const others = useful.then(() => page.loadTabs());
        page.scene.open(scene, Promise.race([others, delayed]));
      },
      pace: (factor) => page.scene.pace(factor),
      maps: (maps, inputTime) => {
        if (!this.trace) return;
        page.maps.draw(maps, this.trace, page.tabs?.compare.name);
        setPanelState(html('#heatmaps'), 'ready');
        stats.maps = { serial: maps.serial, step: maps.step, size: maps.size };
        if (inputTime !== null) addLatency(stats.scrub, performance.now() - inputTime);
        markUseful();
      },
      noMaps: (step, size, reason) => {
        setPanelState(html('#heatmaps'), 'empty', reason);
        stats.maps = { step, size };
        markUseful();
      },
      drawn: (step, inputTime) => {
        page.scene.drawn(this.trace?.header.scene ?? []);
        stats.drawn = { step };
        if (inputTime !== null) addLatency(stats.scene, performance.now() - inputTime);
      },
      error: (line) => this.#messages.show('cursor', line),
      connection: (problem) => {
        this.#messages.show('connection', problem ?? '');
        if (!problem && this.failure) this.load();
      },
    };
  }

  /** @param {() => void} refreshPickers */
  liveHandlers(refreshPickers) {
    const page = this.#page;
    return {
      grown: (/** @type {Trace} */ trace, /** @type {boolean} */ hasNewColumns) =>
        this.#grow(trace, hasNewColumns),
      ended: (/** @type {Trace} */ trace) => {
        page.timeline.grow();
        page.tabs?.diagnostics.show(trace);
        page.tabs?.diagnosis.show(trace);
        page.tabs?.failures.show(trace);
      },
      listed: refreshPickers,
      message: (/** @type {string} */ text) => this.#messages.show('live', text),
      deleted: (/** @type {string} */ text) => {
        this.#messages.show('cursor'); // about the same run
        this.#messages.show('deleted', text);
      },
    };
  }
}

/** @param {boolean} playing */
function showPlaying(playing) {
  document.body.classList.toggle('playing', playing);
  html('#play').ariaLabel = playing ? 'Pause' : 'Play';
}
