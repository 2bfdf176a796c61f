/** The fine-tuning runs of a task: their criterion and outcome in a table, their validations in one chart. */

/** @import { Store } from '../core/state.js' */
/** @import { FineTuneDetails, FineTuneProgress, FineTuneRunInfo, FineTuneRunSummary, FineTuneSettings, Job, Plot, ResultViews, Success } from '../types/server.js' */

import { columnHeading, create, createButton, fillTable } from '../core/dom.js';
import { displayName, percent } from '../core/units.js';
import { Figures } from '../widgets/figures.js';
import { jobSummary } from '../widgets/jobs.js';

const PLACES = { default: 'promoted', saved: 'saved' };
const COLUMNS = [
  'run',
  'base',
  'trained',
  'data',
  'criterion',
  'outcome',
  'change',
  'elsewhere',
  '',
];

export class FinetuneRuns {
  #host;
  #store;
  #figures;
  #table = create(
    'table',
    { ariaLabel: 'Fine-tuning runs, newest first' },
    create('thead'),
    create('tbody'),
  );

  /**
   * @param {HTMLElement} host hidden without runs
   * @param {Store} store
   */
  constructor(host, store) {
    this.#host = host;
    this.#store = store;
    const figures = create('div', { className: 'figures' });
    const scroll = create('div', { className: 'scroll' }, this.#table);
    host.append(create('h4', { textContent: 'Runs' }), scroll, figures);
    this.#figures = new Figures(figures, store);
  }

  redraw() {
    this.#figures.redraw();
  }

  /**
   * @param {FineTuneRunSummary[]} runs newest first
   * @param {FineTuneDetails | null} current
   */
  show(runs, current) {
    this.#host.hidden = !runs.length;
    const names = new Map(runs.map(({ run }, i) => [run, `run ${runs.length - i}`]));
    const rows = runs.map((run) => this.#row(run, names.get(run.run) ?? '', current));
    const headings = COLUMNS.map((title) => columnHeading(title));
    fillTable(this.#table, headings, rows);
    const base = current?.filter ?? this.#store.state.filter;
    const same = runs.filter(({ filter }) => filter === base);
    const task = this.#store.task();
    const plot = task && overlay(same, names, base, task.main.key, task.main.name);
    this.#figures.show(plot ? plotViews([plot]) : null, null);
  }

  /**
   * @param {FineTuneRunSummary} run
   * @param {string} name
   * @param {FineTuneDetails | null} current
   */
  #row(run, name, current) {
    const {
      job,
      success,
      settings,
      saved_as: place,
    } = run.run === current?.run ? { ...run, job: current.job } : run; // the list is older
    const link = createButton('title', name, () => this.#store.set({ run: run.run }));
    const outcome = success && outcomeView(success.outcome, notExcluded(success));
    const [target, ...others] = success?.slices ?? [];
    const worst = others.sort((a, b) => Number(b.change) - Number(a.change))[0];
    const state = run.finetuned ? 'no criterion' : job ? stateOf(job) : 'removed';
    const texts = [
      run.filter,
      settings.train.map(presetName).join(', '),
      trainingData(run),
      settings.success ? criterionText(settings.success) : '–',
      outcome?.text ?? state,
      target ? changeText(target) : '',
      worst ? `${displayName(worst.slice)} ${changeText(worst)}` : '',
      place ? PLACES[place] : '',
    ];
    const cells = texts.map((textContent) => create('td', { textContent, title: textContent }));
    cells[4].dataset.outcome = outcome?.tone ?? '';
    const row = create('tr', {}, create('td', {}, link), ...cells);
    row.classList.toggle('here', run.run === current?.run);
    return row;
  }
}

/** @param {string} name of a preset, or of a module, which is returned unchanged */
export const presetName = (name) => name.replace(/-only$/, ' only');

/**
 * Returns the names of the data slices that a run was trained on.
 * @param {FineTuneRunInfo} run
 */
export const trainingData = ({ settings }) =>
  settings.mix.map(({ slice }) => displayName(slice.name)).join(' and ') || 'clean data';

/**
 * Returns the change of the error in each run's slice over its steps, of runs with the same base.
 * @param {FineTuneRunSummary[]} runs
 * @param {Map<string, string>} names
 * @param {string} base
 * @param {string} key of the main error
 * @param {string} quantity
 * @returns {Plot | null}
 */
function overlay(runs, names, base, key, quantity) {
  const lines = runs.flatMap(({ run, settings, progress }) => {
    const validations = progress?.validations ?? [];
    const candidates = [criterionSlice(settings), settings.mix[0]?.slice.name, 'clean'];
    const slice = candidates.find((name) => name && name in (validations[0]?.slices ?? {}));
    if (!slice || validations.length < 2) return [];
    const y = changes(validations, slice, key);
    return [
      {
        name: `${names.get(run)}: ${displayName(slice)}`,
        layer: '',
        x: validations.map((v) => v.step),
        y,
      },
    ];
  });
  if (lines.length < 2) return null;
  return linePlot(`Runs of ${base}`, `change of the ${quantity} error, %`, lines);
}

/**
 * @param {string} title
 * @param {string} label of the y axis
 * @param {Plot['lines']} lines
 * @returns {Plot}
 */
export const linePlot = (title, label, lines) => ({
  ...{ title, x_label: 'step', y_label: label, lines },
  ...{ kind: 'line', diagonal: false, names: [] },
});

/**
 * Returns plots as the figures of a result without others.
 * @param {Plot[]} plots
 * @returns {ResultViews}
 */
export const plotViews = (plots) => ({
  ...{ verdict: '', curves: [], bands: {}, tables: [], images: [] },
  plots,
});

/**
 * Returns the slice of a run's success criterion; empty without one.
 * @param {FineTuneSettings} settings
 */
export const criterionSlice = ({ success }) => (success ?? '').split(':')[0];

/**
 * Returns the limits of a criterion in percent.
 * @param {string} text
 */
export function limits(text) {
  const value = (/** @type {string} */ key) => text.match(`:${key}=([\\d.e+-]+)`)?.[1];
  return { by: Number(value('by') ?? 10), others: Number(value('others') ?? 5) };
}

/**
 * Describes a criterion: image noisy at least 10 % better, others at most 5 % worse.
 * @param {string} text
 */
export function criterionText(text) {
  const { by, others } = limits(text);
  const [slice] = text.split(':');
  return `${displayName(slice)} at least ${by} % better, others at most ${others} % worse`;
}

/**
 * Returns the change of the error in a slice since the first validation, in percent.
 * @param {FineTuneProgress['validations']} validations
 * @param {string} slice
 * @param {string} key of the error
 */
export function changes(validations, slice, key) {
  const [first, ...others] = validations.map(({ slices }) => Number(slices[slice].rmse[key]));
  return [first, ...others].map((value) => 100 * (value / first - 1));
}

/** @param {Job} job */
function stateOf(job) {
  if (job.state === 'running') return `running, ${percent(job.progress)}`;
  return job.state === 'cancelled' ? 'paused' : jobSummary(job); // as in the run itself
}

/**
 * Returns the slices in which the episodes do not exclude a change beyond the limit of a criterion that is met.
 * @param {Success} success older results do not name them
 */
export const notExcluded = ({ slices, not_excluded: names }) =>
  slices.filter(({ slice }) => names?.includes(slice));

/**
 * Returns the outcome of a criterion or of one slice as text, and its colour.
 * @param {Success['outcome']} outcome
 * @param {Success['slices']} slices of these whose limit is not excluded
 */
export function outcomeView(outcome, [slice]) {
  if (!slice) return { text: outcome, tone: outcome };
  return { text: `met; +${percent(slice.limit)} not excluded`, tone: 'not excluded' };
}

/** @param {number} value */
const signedPercent = (value) => `${value >= 0.005 ? '+' : ''}${percent(value)}`;

/**
 * @param {{change: number | null, low: number | null, high: number | null}} slice
 */
export function changeText({ change, low, high }) {
  const range =
    low === null || high === null ? '' : ` (${signedPercent(low)} to ${signedPercent(high)})`;
  return `${signedPercent(change ?? NaN)}${range}`;
}
