/** All tabs except the 3D scene. The page imports this module when the run is displayed. */

/** @import { Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { Timeline } from '../timeline/timeline.js' */
/** @import { FaultDialog } from '../widgets/fault_dialog.js' */
/** @import { FindingBar } from '../widgets/finding_bar.js' */
/** @import { Jobs } from '../widgets/jobs.js' */

import { html } from '../core/dom.js';
import { ComparisonTab } from './comparison.js';
import { Diagnosis } from './diagnosis.js';
import { Diagnostics } from './diagnostics.js';
import { Experiments } from './experiments.js';
import { Failures } from './failures.js';
import { Finetune } from './finetune.js';
import { Recordings } from './recordings.js';
import { Rerun } from './rerun.js';
import { Study } from './study.js';

/**
 * The parts of the page that tabs use. `reload` loads the trace again; `setComparison` displays a comparison run in the
 * timeline and in the scene, or removes it.
 * @typedef {{
 *   jobs: Jobs,
 *   timeline: Timeline,
 *   finding: FindingBar,
 *   faultDialog: FaultDialog,
 *   reload: () => void,
 *   setComparison: (trace: Trace | null, name: string) => void,
 * }} PageParts
 */

export class Tabs {
  #store;

  /**
   * @param {Store} store
   * @param {PageParts} parts
   */
  constructor(store, { jobs, timeline, finding, faultDialog, reload, setComparison }) {
    this.#store = store;
    this.rerun = new Rerun(html('#rerun'), store, jobs);
    this.diagnosis = new Diagnosis(html('#diagnosis'), store, jobs, timeline);
    this.diagnosis.confirmed = (trace, result) => finding.confirm(trace, result);
    this.diagnosis.recorded = reload;
    this.diagnostics = new Diagnostics(html('#diagnostics'), store, jobs);
    this.failures = new Failures(html('#failures'), store, jobs, timeline);
    this.compare = new ComparisonTab(html('#compare'), store, faultDialog, setComparison);
    this.finetune = new Finetune(html('#finetune'), store, jobs, faultDialog);
    this.study = new Study(html('#study'), store, this.failures, jobs);
    this.experiments = new Experiments(html('#experiments'), store);
    this.recordings = new Recordings(html('#recordings'), store, jobs, this.rerun);
    if (store.state.recording) this.recordings.showOpened();
  }

  /** @param {Trace} trace */
  show(trace) {
    this.rerun.show(trace);
    this.diagnosis.show(trace);
    this.diagnostics.show(trace);
    this.failures.show(trace);
    this.compare.show(trace);
  }

  /** @param {string} reason why no run is displayed */
  fail(reason) {
    this.diagnosis.fail(reason);
    this.diagnostics.fail(reason);
    this.compare.fail(reason);
  }

  /**
   * Moves the cursor.
   * @param {number} step
   * @param {boolean} fromRerun whether Rerun's viewer has moved it
   */
  move(step, fromRerun) {
    this.diagnostics.move(step);
    this.failures.move(step);
    this.compare.move(step);
    this.rerun.move(step, fromRerun);
  }

  /**
   * Updates what depends on the changed keys of the state.
   * @param {Set<string>} changed
   * @param {boolean} hasTrace
   */
  follow(changed, hasTrace) {
    /** @param {...string} keys */
    const any = (...keys) => keys.some((key) => changed.has(key));
    if (any('recording')) this.recordings.showOpened();
    else if (any('task', 'filter', 'data', 'episode', 'faults')) this.#store.set({ recording: '' });
    if (any('diagnostic', 'options', 'over')) this.diagnostics.choose();
    if (any('over')) this.diagnosis.load();
    if (any('against') && hasTrace) this.compare.choose();
    if (any('task', 'filter', 'data', 'faults', 'among')) this.failures.load();
    else if (any('by', 'phase', 'list')) this.failures.draw();
    if (any('task', 'filter', 'data', 'episode', 'faults', 'run')) this.finetune.load();
  }

  /** @param {string} tab displayed now */
  open(tab) {
    this.rerun.open = tab === 'rerun';
    this.diagnosis.open = tab === 'diagnosis';
    this.diagnostics.open = tab === 'diagnostics';
    this.failures.draw();
    this.compare.open = tab === 'compare';
    this.recordings.open = tab === 'recordings';
    this.finetune.open = tab === 'finetune';
    this.study.open = tab === 'study';
    this.experiments.open = tab === 'experiments';
  }

  redraw() {
    this.diagnostics.redraw();
    this.compare.redraw();
    this.finetune.redraw();
    this.experiments.redraw();
  }
}
