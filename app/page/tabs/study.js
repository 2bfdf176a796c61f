/** The Study tab: errors of all filters by share of image blackout, as bars and as a table with links to the failures. */

/** @import { State, Store } from '../core/state.js' */
/** @import { Job, StudyInfo, StudyTask, Task } from '../types/server.js' */
/** @import { Bar } from '../widgets/bar_chart.js' */
/** @import { Jobs } from '../widgets/jobs.js' */
/** @import { Failures } from './failures.js' */
/** @import { Quantity } from './study_quantities.js' */
/** @import { FilterResults, StudyView } from './study_table.js' */

import { element, html, messageOf, setOptions } from '../core/dom.js';
import { permalink } from '../core/state.js';
import { fixed, plural, sentence } from '../core/units.js';
import * as api from '../data/api.js';
import { BarChart } from '../widgets/bar_chart.js';
import { colourOf } from '../widgets/filter_colours.js';
import { isActive, jobSummary } from '../widgets/jobs.js';
import { setPanelState } from '../widgets/panel_state.js';
import { choice } from '../widgets/pickers.js';
import { missingStudy } from './missing_study.js';
import { blackoutLabel, failuresOf, startLabel, studyQuantities } from './study_quantities.js';
import { StudyTable } from './study_table.js';

const BUILT_IN = 'shipped'; // its name in files and addresses
const LEGEND =
  'Bars: mean over the seeds ± standard deviation, in the order and colours of the table. Dots: seeds; a click opens the ringed one.';

const BODY = `
  <div class="top">
    <label class="picker">Study <select aria-label="Study"></select></label>
    <div id="quantity" class="choice" role="radiogroup" aria-label="Quantity"></div>
    <div id="start" class="choice" role="radiogroup" aria-label="Start of the runs"></div>
  </div>
  <p class="about"></p>
  <p class="problems" role="status"></p>
  <div class="cells" role="status" hidden><progress max="1" aria-label="Progress of the study's cells"></progress><span></span> <button type="button" class="text">Train them</button></div>
  <div class="chart"></div>
  <p class="description" aria-hidden="true"></p>
  <div class="scroll" tabindex="-1"><table><thead></thead><tbody></tbody></table></div>
  <p class="note"></p>`;

/** Target of a bar's link. @typedef {{patch: Partial<State>, task: string, filter: string, seed: number, inCatalog: boolean}} Target */

export class Study {
  #host;
  #store;
  #failures;
  #jobs;
  #chart;
  #table;
  #open = false;
  /** @type {StudyInfo[] | null} */
  #studies = null;
  /** @type {string[]} */
  #problems = [];
  #loadedProgress = ''; // of the study's job when the results were loaded
  /** Targets of the bars by their labels. @type {Map<string, Target>} */
  #targets = new Map();

  /**
   * @param {HTMLElement} host
   * @param {Store} store
   * @param {Failures} failures
   * @param {Jobs} jobs
   */
  constructor(host, store, failures, jobs) {
    this.#host = host;
    this.#store = store;
    this.#failures = failures;
    this.#jobs = jobs;
    host.innerHTML = BODY;
    this.#chart = new BarChart(html('.chart', host), (bar) => this.#describe(bar));
    this.#table = new StudyTable(element('table', HTMLTableElement, host), (filter) =>
      this.#chart.mark(filter),
    );
    const picker = element('select', HTMLSelectElement, host);
    picker.addEventListener('change', () => store.set({ study: picker.value }));
    host.addEventListener('click', (event) => this.#followLink(event));
    html('.cells button', host).addEventListener('click', () => this.#trainOrCancel());
    jobs.listen(() => this.#followJobs());
    store.when(['task', 'study', 'quantity', 'start', 'data'], () => this.#draw());
  }

  /** Whether the tab is selected. */
  set open(/** @type {boolean} */ open) {
    if (open && !this.#open) this.#load();
    this.#open = open;
  }

  async #load() {
    if (!this.#studies) setPanelState(this.#host, 'loading', 'Loading …');
    try {
      const { studies, problems } = await api.studies();
      this.#studies = studies;
      this.#problems = problems;
      this.#loadedProgress = this.#progress;
      this.#draw();
    } catch (error) {
      setPanelState(this.#host, 'error', messageOf(error));
    }
  }

  /** The displayed study: the selected one, or the first one that contains the task. @returns {StudyInfo | undefined} */
  get #study() {
    const { study, task } = this.#store.state;
    return (
      this.#studies?.find(({ name }) => name === study) ??
      this.#studies?.find(({ tasks }) => tasks.some(({ name }) => name === task)) ??
      this.#studies?.[0]
    );
  }

  /** The job that trains the unfinished cells of the study. @returns {Job | undefined} */
  get #job() {
    return this.#jobs.find(this.#study?.job);
  }

  get #progress() {
    return `${this.#job?.state} ${this.#job?.progress}`;
  }

  #draw() {
    const study = this.#study;
    if (!study || !this.#studies) return;
    const { state } = this.#store;
    const picker = element('select', HTMLSelectElement, this.#host);
    const options = this.#studies.map(({ name }) => [
      name,
      name === BUILT_IN ? 'built-in study' : name,
    ]);
    setOptions(picker, options, study.name);
    html('.picker', this.#host).hidden = this.#studies.length < 2;
    html('.problems', this.#host).textContent = this.#problems.map(sentence).join(' ');
    this.#drawCells(study);
    const results = study.tasks.find(({ name }) => name === state.task);
    const task = this.#store.task();
    if (!results || !task) {
      setPanelState(this.#host, 'empty');
      const note = html('.note', this.#host);
      note.replaceChildren(...missingStudy(study, this.#store));
      return;
    }
    const quantities = studyQuantities(results.rows, task);
    const quantity = quantities.find(({ key }) => key === state.quantity) ?? quantities[0];
    choice(
      html('#quantity', this.#host),
      quantities.map(({ key, title }) => [key, title]),
      quantity.key,
      (key) => this.#store.set({ quantity: key }),
    );
    const starts = [...new Set(results.rows.filter(isOfFilter).map((row) => row.start))];
    const start = state.start === 'truth' && starts.includes('') ? '' : starts[0];
    choice(
      html('#start', this.#host),
      starts.map((text) => [text ? 'offset' : 'truth', startLabel(text)]),
      start ? 'offset' : 'truth',
      (key) => this.#store.set({ start: key }),
    );
    const view = this.#view(results, task, quantity, start);
    html('.about', this.#host).textContent = summary(study, results, view);
    this.#drawChart(view);
    this.#table.show(view);
    setPanelState(this.#host, 'ready');
  }

  /**
   * Shows the number of unfinished cells and a button to train them, or the progress of the training.
   * @param {StudyInfo} study
   */
  #drawCells({ unfinished, cells, why_not: whyNot }) {
    const job = this.#job;
    const isTraining = isActive(job);
    const host = html('.cells', this.#host);
    host.hidden = !unfinished && !isTraining;
    const progress = element('progress', HTMLProgressElement, host);
    progress.hidden = !isTraining;
    progress.value = job?.progress ?? 0;
    const count = `${unfinished} of ${cells} cells ${unfinished === 1 ? 'is' : 'are'} not trained.`;
    const failure = job && !isTraining && job.state !== 'done' ? ` ${jobSummary(job)}` : '';
    const reason = whyNot ? ` They cannot be trained here: ${sentence(whyNot)}` : '';
    html('span', host).textContent =
      job && isTraining ? `Training cells: ${jobSummary(job)}` : `${count}${failure}${reason}`;
    const button = html('button', host);
    button.textContent = isTraining ? 'Cancel' : unfinished === 1 ? 'Train it' : 'Train them';
    button.hidden = !isTraining && Boolean(whyNot);
  }

  /** Starts the training of the unfinished cells, or cancels it. */
  async #trainOrCancel() {
    const study = this.#study;
    if (!study) return;
    const job = this.#job;
    if (job && isActive(job)) return this.#jobs.cancel(job.id);
    try {
      study.job = (await api.trainStudy(study.name)).job.id;
      await this.#jobs.refresh();
    } catch (error) {
      html('.problems', this.#host).textContent = messageOf(error);
    }
  }

  /** Loads the results again after each trained cell. */
  #followJobs() {
    const study = this.#study;
    if (!study || !this.#open) return;
    this.#drawCells(study);
    if (this.#progress === this.#loadedProgress) return;
    this.#loadedProgress = this.#progress;
    this.#load();
  }

  /**
   * Collects the results of a task, and the targets of their links.
   * @param {StudyTask} results
   * @param {Task} task
   * @param {Quantity} quantity
   * @param {string} start
   * @returns {StudyView}
   */
  #view(results, task, quantity, start) {
    const ofStart = results.rows.filter((row) => isOfFilter(row) && row.start === start);
    const blackouts = [...new Set(ofStart.map(({ blackout }) => blackout))];
    this.#targets.clear();
    const names = results.filters.map(({ name }) => name);
    const filters = results.filters.map(({ name, trained }) => {
      const checkpoint =
        trained.find((seed) => seed.catalog_name) ?? trained.find(({ file }) => file) ?? null;
      const ofFilter = ofStart.filter(({ filter }) => filter === name);
      const rows = blackouts.flatMap((share) => ofFilter.filter((row) => row.blackout === share));
      const colour = colourOf(name, names);
      const bars = rows.map((row) => ({ ...this.#bar(row, checkpoint, task, quantity), colour }));
      return { name, colour, checkpoint, rows, bars };
    });
    const level = referenceLevel(results.rows, start, quantity);
    return { task: task.name, quantity, start, blackouts, filters, level };
  }

  /**
   * @param {StudyTask['rows'][number]} row
   * @param {FilterResults['checkpoint']} checkpoint
   * @param {Task} task
   * @param {Quantity} quantity
   * @returns {Omit<Bar, 'colour'>}
   */
  #bar(
    { filter, blackout, mean: means, spread: spreads, by_seed, failed },
    checkpoint,
    task,
    quantity,
  ) {
    const { key, unit } = quantity;
    const [mean, spread] = [means[key] ?? null, spreads[key] ?? null];
    const dots = Object.entries(by_seed).flatMap(([seed, values]) => {
      const value = values[key] ?? null;
      return value === null ? [] : [{ seed, value, here: Number(seed) === checkpoint?.seed }];
    });
    const seeds = dots.map(({ seed, value }) => `seed ${seed}: ${fixed(value, 2)}`).join(', ');
    const number =
      mean === null
        ? failed
          ? 'failed'
          : 'missing'
        : `${fixed(mean, 2)}${spread === null ? '' : ` ± ${fixed(spread, 2)}`}${unit && ` ${unit}`}`;
    const name = checkpoint?.catalog_name ?? '';
    const effect = checkpoint
      ? `opens the worst events of seed ${checkpoint.seed}${name ? '' : ', which is added to the catalog'}`
      : 'its weights are not available';
    const label = `${filter}, ${blackoutLabel(blackout)}: ${number}${seeds && ` (${seeds})`}; ${effect}`;
    if (!checkpoint) return { filter, mean, spread, dots, label, href: null };
    const patch = failuresOf(this.#store.state, task, name, blackout, quantity);
    const { seed } = checkpoint;
    this.#targets.set(label, { patch, task: task.name, filter, seed, inCatalog: Boolean(name) });
    const href = permalink({ ...this.#store.state, ...patch });
    return { filter, mean, spread, dots, label, href };
  }

  /** @param {StudyView} view */
  #drawChart({ quantity, start, blackouts, filters, level }) {
    html('.chart', this.#host).dataset.row = String(filters.length);
    this.#chart.show({
      label: `${quantity.description} by filter and share of image blackout, start ${startLabel(start)}`,
      unit: quantity.unit && `RMSE, ${quantity.unit}`,
      level: quantity.key === 'nees' ? { name: 'consistent', value: 1 } : level,
      groups: blackouts.map((share, i) => ({
        name: blackoutLabel(share),
        bars: filters.map(({ bars }) => bars[i]),
      })),
    });
    this.#describe(null);
  }

  /** @param {Bar | null} bar under the pointer */
  #describe(bar) {
    html('.description', this.#host).textContent = bar ? `${bar.label}.` : LEGEND;
    this.#table.mark(bar?.filter ?? '');
  }

  /**
   * Opens the failures of the clicked bar or number without loading the page again.
   * @param {MouseEvent} event
   */
  #followLink(event) {
    const link = event.target instanceof Element ? event.target.closest('a') : null;
    const label = link?.getAttribute('aria-label') ?? link?.dataset.label;
    const target = this.#targets.get(label ?? '');
    if (!target || event.ctrlKey || event.metaKey || event.shiftKey) return;
    event.preventDefault();
    this.#openTarget(target);
  }

  /** @param {Target} target */
  async #openTarget({ patch, task, filter, seed, inCatalog }) {
    const study = this.#study;
    if (!study) return;
    if (!inCatalog) {
      try {
        const added = await api.addStudyFilter(study.name, task, filter, seed);
        const link = permalink({ ...this.#store.state, ...patch, filter: added.filter });
        location.assign(`/${link}`); // loads the catalog again
      } catch (error) {
        html('.problems', this.#host).textContent = messageOf(error);
      }
      return;
    }
    this.#store.set({ ...patch, playing: false });
    this.#store.flush();
    this.#failures.goToWorst();
  }
}

/** Whether a row has results of a filter, not those of the training mean. @param {StudyTask['rows'][number]} row */
const isOfFilter = ({ blackout }) => blackout !== null;

/**
 * Returns the error of a predictor without observations: from offset starts the baseline that keeps the start, at the
 * truth the training mean.
 * @param {StudyTask['rows']} rows
 * @param {string} start
 * @param {Quantity} quantity
 */
function referenceLevel(rows, start, { key }) {
  const reference = start
    ? rows.find((row) => row.start === start && row.baselines.stay)?.baselines.stay
    : rows.find((row) => !isOfFilter(row))?.mean;
  const value = reference?.[key] ?? null;
  return value === null ? null : { name: start ? 'stay' : 'training mean', value };
}

/**
 * Describes how the filters were trained and evaluated, and what a click opens.
 * @param {StudyInfo} study
 * @param {StudyTask} results
 * @param {StudyView} view
 */
function summary({ preset }, results, { quantity, start, filters }) {
  const opened = filters.flatMap(({ checkpoint }) => (checkpoint ? [checkpoint.seed] : []));
  const missing = filters.filter(({ checkpoint }) => !checkpoint).map(({ name }) => name);
  const seeds = Math.max(...filters.flatMap(({ rows }) => rows.map((row) => row.seeds)));
  const training = `${plural(seeds, 'seed')} per filter, trained on ${results.data || 'unknown data'} (preset ${preset})`;
  const evaluation = (start && results.offset_data) || 'its test episodes';
  const text = `${quantity.description}, runs that start ${startLabel(start)}: ${training} and evaluated on ${evaluation}.`;
  if (!opened.length) return `${text} The weights are not available here.`;
  const seedList = [...new Set(opened)].sort().join(' or ');
  const link = `A click opens the failures of seed ${seedList} on the held-out episodes of the catalog`;
  const rest = missing.length
    ? `; the weights of ${missing.join(', ').replace(/, ([^,]+)$/, ' and $1')} are not available`
    : '';
  return `${text} ${link}${rest}.`;
}
