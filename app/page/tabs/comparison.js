/** The run that is shown beside another one: what differs, drawn over the time line and told in this panel. */

import * as api from '../data/api.js';
import { Edit } from './comparison_form.js';
import { Figures } from '../widgets/figures.js';
import { setPanelState } from '../widgets/panel_state.js';

const NOTHING =
  'Nothing to compare with yet. Choose another filter, other sensors or an edit over some steps, and run it beside this one.';

export class Compare {
  #catalog;
  #store;
  #result;
  #figures;
  #form;
  #overlay;
  #trace = null;
  #other = null;
  #gain;
  /** What the other run is called in a sentence; empty without one. */
  name = '';
  #loading = new AbortController();
  #open = false;

  /**
   * @param {HTMLElement} host @param {import('../data/api.js').Catalog} catalog @param {import('../core/state.js').Store} store
   * @param {import('../widgets/fault_dialog.js').FaultDialog} sheet
   * @param {(other: import('../data/trace.js').Trace | null, label: string) => void} overlay is told of the other run as it comes and goes
   */
  constructor(host, catalog, store, sheet, overlay) {
    [this.#catalog, this.#store, this.#overlay] = [catalog, store, overlay];
    this.#result = host.querySelector('.result');
    this.#gain = host.querySelector('.gain');
    this.#gain.addEventListener('change', ({ target }) =>
      store.set({ beside: target.checked ? 'gain' : 'alone' }),
    );
    store.listen((_, changed) => changed.has('beside') && this.#showGain());
    this.#figures = new Figures(host.querySelector('.figures'), store);
    this.#form = new Edit(host.querySelector('form'), catalog, store, sheet, (against) =>
      api.checkSelection({ ...store.state, against }),
    );
    setPanelState(this.#result, 'loading', 'Loading …');
    this.#showGain();
  }

  /** Whether the panel can be seen. */
  set open(open) {
    this.#open = open;
    if (open && this.#trace) this.move(this.#store.state.step);
  }

  /** @param {import('../data/trace.js').Trace} trace that the page shows */
  show(trace) {
    this.#trace = trace;
    this.choose();
  }

  /** Another other run was chosen. */
  choose() {
    if (!this.#trace) return;
    this.#form.show(this.#trace);
    this.#load();
  }

  move(step) {
    if (this.#open) this.#figures.move(step);
  }

  redraw() {
    this.#figures.redraw();
  }

  /** An edit begins or ends at a step. @param {'from' | 'last'} end */
  mark(end, step) {
    this.#form.mark(end, step);
  }

  /** Loads the other run, and what is said of both. */
  async #load() {
    const { against, task: name } = this.#store.state;
    this.#loading.abort();
    const { signal } = (this.#loading = new AbortController());
    this.#draw(null, '');
    this.#show(null);
    if (!against) return setPanelState(this.#result, 'empty', NOTHING);
    const wait = (share) => setPanelState(this.#result, 'loading', 'Running the other one …', share);
    wait(null);
    try {
      const task = this.#catalog.tasks.find((t) => t.name === name);
      const selection = { ...this.#trace.selection, against };
      const other = await api.loadTrace(task, selection, wait, signal);
      const found = await api.comparison(selection, signal);
      this.#draw(other, found.names[1], found.edit ? 'the edited run' : found.names[1]);
      this.#show(found);
      setPanelState(this.#result, 'ready');
    } catch (error) {
      if (error.name === 'AbortError') return;
      if (!(error instanceof api.ServerError)) console.error(error);
      setPanelState(this.#result, 'error', error.message);
    }
  }

  #draw(other, label, name = label) {
    if (other === this.#other) return;
    [this.#other, this.name] = [other, name];
    this.#overlay(other, label);
    this.#showGain();
  }

  /** Whether the maps show what they gain on the other run's, or why they cannot. */
  #showGain() {
    const [box, text] = this.#gain.children;
    const none = this.#other && whyNoGain(this.#trace, this.#other);
    this.#gain.hidden = !this.#other;
    [box.checked, box.disabled] = [this.#store.state.beside === 'gain' && !none, Boolean(none)];
    text.textContent = none ?? `In the maps, show what this run gains on ${this.name}`;
  }

  #show(found) {
    this.#result.querySelector('.verdict').textContent = found?.verdict ?? '';
    this.#figures.show(found, this.#trace);
    if (this.#open) this.#figures.move(this.#store.state.step);
  }
}

/** Why the maps of two runs cannot be set against each other, in a line; null where they can. */
function whyNoGain(trace, other) {
  if (trace.header.no_maps || other.header.no_maps)
    return `No gain in the maps: ${trace.header.no_maps ?? other.header.no_maps}.`;
  if (trace.modalities.join() === other.modalities.join()) return null;
  return 'No gain in the maps: the runs do not have the same modalities.';
}
