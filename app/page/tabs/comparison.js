/** The comparison run: drawn over the timeline, and compared with the current run in this panel. */

/** @import { Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { Comparison } from '../types/server.js' */
/** @import { FaultDialog } from '../widgets/fault_dialog.js' */

import { element, html, isAbort, messageOf } from '../core/dom.js';
import { percent, typeset } from '../core/units.js';
import * as api from '../data/api.js';
import { Figures } from '../widgets/figures.js';
import { setPanelState } from '../widgets/panel_state.js';
import { ComparisonForm } from './comparison_form.js';

const NO_COMPARISON =
  'No comparison yet. Choose another filter, other sensor faults, the standalone filter of a modality or an intervention over some steps, then compare.';

export class ComparisonTab {
  #store;
  #result;
  #figures;
  #form;
  #overlay;
  /** @type {Trace | null} */
  #trace = null;
  /** @type {Trace | null} */
  #other = null;
  #gain;
  #gainBox;
  /** Name of the comparison run in a sentence; empty without one. */
  name = '';
  #loading = new AbortController();
  #open = false;

  /**
   * @param {HTMLElement} host
   * @param {Store} store
   * @param {FaultDialog} dialog
   * @param {(other: Trace | null, label: string) => void} overlay called when the comparison run changes
   */
  constructor(host, store, dialog, overlay) {
    this.#store = store;
    this.#overlay = overlay;
    this.#result = html('.result', host);
    this.#gain = html('.gain', host);
    this.#gainBox = element('input', HTMLInputElement, this.#gain);
    this.#gainBox.addEventListener('change', () =>
      store.set({ beside: this.#gainBox.checked ? 'gain' : 'alone' }),
    );
    store.when(['beside'], () => this.#showGain());
    this.#figures = new Figures(html('.figures', host), store);
    const form = element('form', HTMLFormElement, host);
    this.#form = new ComparisonForm(form, store, dialog, (against) =>
      api.checkSelection({ ...store.state, against }),
    );
    setPanelState(this.#result, 'loading', 'Loading …');
    this.#showGain();
  }

  /** Whether the panel is visible. */
  set open(/** @type {boolean} */ open) {
    this.#open = open;
    if (open && this.#trace) this.move(this.#store.state.step);
  }

  /** @param {Trace} trace the current run */
  show(trace) {
    this.#trace = trace;
    this.choose();
  }

  /** @param {string} reason why no run is displayed */
  fail(reason) {
    this.#loading.abort();
    this.#trace = null;
    this.#setOther(null, '');
    this.#show(null);
    setPanelState(this.#result, 'empty', reason);
  }

  /** Loads the comparison run of the state. */
  choose() {
    if (!this.#trace) return;
    this.#form.show(this.#trace);
    this.#load(this.#trace);
  }

  /** @param {number} step */
  move(step) {
    if (this.#open) this.#figures.move(step);
  }

  redraw() {
    this.#figures.redraw();
  }

  /**
   * Lets an intervention begin at a step, or end after it.
   * @param {'from' | 'to'} end
   * @param {number} step
   */
  mark(end, step) {
    this.#form.mark(end, step);
  }

  /** @param {Trace} trace */
  async #load(trace) {
    const { against } = this.#store.state;
    this.#loading.abort();
    const { signal } = (this.#loading = new AbortController());
    this.#setOther(null, '');
    this.#show(null);
    if (!against) return setPanelState(this.#result, 'empty', NO_COMPARISON);
    const progress = (/** @type {number | null} */ share) => {
      setPanelState(this.#result, 'loading', 'Computing the comparison run …', share);
      this.#overlay(null, share === null ? 'computing …' : `computing, ${percent(share)}`);
    };
    progress(null);
    try {
      const task = this.#store.task() ?? this.#store.catalog.tasks[0];
      const selection = { ...trace.selection, against };
      const other = await api.loadTrace(task, selection, progress, signal);
      const result = await api.comparison(selection, signal);
      const label = result.names[1];
      this.#setOther(other, label, result.intervention ? 'the run with the intervention' : label);
      this.#show(result);
      setPanelState(this.#result, 'ready');
    } catch (error) {
      if (isAbort(error)) return;
      this.#overlay(null, '');
      if (!(error instanceof api.ServerError)) console.error(error);
      setPanelState(this.#result, 'error', messageOf(error));
    }
  }

  /**
   * @param {Trace | null} other
   * @param {string} label
   * @param {string} [name]
   */
  #setOther(other, label, name = label) {
    if (other === this.#other) return this.#overlay(other, label);
    this.#other = other;
    this.name = name;
    this.#overlay(other, label);
    this.#showGain();
  }

  /** Shows whether the maps display the difference of the two runs, or why they cannot. */
  #showGain() {
    const reason = this.#trace && this.#other && noGainReason(this.#trace, this.#other);
    this.#gain.hidden = !this.#other;
    this.#gainBox.checked = this.#store.state.beside === 'gain' && !reason;
    this.#gainBox.disabled = Boolean(reason);
    html('span', this.#gain).textContent =
      reason ?? `In the maps, show the change from ${this.name}`;
  }

  /** @param {Comparison | null} result */
  #show(result) {
    html('.verdict', this.#result).textContent = typeset(result?.verdict ?? '');
    this.#figures.show(result, this.#trace);
    if (this.#open) this.#figures.move(this.#store.state.step);
  }
}

/**
 * Returns why the maps of two runs cannot be subtracted; null if they can.
 * @param {Trace} trace
 * @param {Trace} other
 */
function noGainReason(trace, other) {
  const noMaps = trace.header.no_maps ?? other.header.no_maps;
  if (noMaps) return `No difference in the maps: ${noMaps}.`;
  if (trace.modalities.join() === other.modalities.join()) return null;
  return 'No difference in the maps: the runs have different modalities.';
}
