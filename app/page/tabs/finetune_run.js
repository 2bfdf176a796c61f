/** A fine-tuning run: progress, verdict, decision about the checkpoint, and the changes in detail. */

/** @import { Store } from '../core/state.js' */
/** @import { FineTuneDetails, FineTuneProgress, FineTuneSettings, Job, Plot, RegressionEvent, ResultViews, Success, Task } from '../types/server.js' */

import { columnHeading, create, createButton, element, fillTable, html } from '../core/dom.js';
import {
  displayName,
  fixed,
  mainText,
  percent,
  significant,
  withUnit,
  typeset,
} from '../core/units.js';
import { Figures } from '../widgets/figures.js';
import { isActive, jobSummary } from '../widgets/jobs.js';
import {
  changeText,
  changes,
  criterionSlice,
  criterionText,
  limits,
  linePlot,
  notExcluded,
  outcomeView,
  plotViews,
  trainingData,
} from './finetune_runs.js';

/** @typedef {'promote' | 'save' | 'discard'} Decision */

const SAVED_AS = {
  saved: 'The fine-tuned checkpoint is in the catalog, next to its base checkpoint.',
  default: 'The fine-tuned checkpoint is in the catalog, as the default filter of this server.',
};
const NOT_SAVED =
  'The base checkpoint is unchanged. The fine-tuned one is not in the catalog yet: there is nothing to discard.';
const MEASURING =
  'The checkpoint can be promoted or saved when its healthy record is measured, which a diagnosis needs.';
const RESUMES = 'The run resumes from its last validation.';

const BODY = `
  <div class="row"><button type="button" class="text quiet back">‹ New run</button><h3></h3></div>
  <p class="statement"></p>
  <p class="verdict" aria-live="polite"></p>
  <div class="row doing"><progress aria-label="Progress of the fine-tuning" max="1"></progress><button type="button" class="text">Pause</button></div>
  <div class="row decide"></div>
  <table class="slices" aria-label="Success criterion by slice" hidden><thead></thead><tbody></tbody></table>
  <div class="figures live"></div>
  <div class="place"></div>
  <section class="events" hidden><h4>Events that regressed</h4><ol></ol></section>
  <div class="figures report"></div>`;

export class FinetuneRun {
  #host;
  #handlers;
  #store;
  #progress;
  #report;
  #comparison = ''; // displayed, as JSON

  /**
   * @param {HTMLElement} host
   * @param {Store} store
   * @param {{back: () => void, pauseOrResume: () => void, trainLonger: () => void, decide: (decision: Decision, link?: string) => void}} handlers
   *   link: to be opened afterwards
   */
  constructor(host, store, handlers) {
    this.#host = host;
    this.#handlers = handlers;
    this.#store = store;
    host.innerHTML = BODY;
    this.#progress = new Figures(html('.live', host), store);
    this.#report = new Figures(html('.report', host), store);
    html('.back', host).addEventListener('click', handlers.back);
    html('.doing button', host).addEventListener('click', handlers.pauseOrResume);
  }

  redraw() {
    this.#progress.redraw();
    this.#report.redraw();
  }

  /** @param {FineTuneDetails | null} run null hides the panel */
  show(run) {
    this.#host.hidden = !run;
    if (!run) return;
    const { job, result, progress, settings } = run;
    const active = isActive(job);
    const modules = settings.train.map((name) => name.replace('-only', '')).join(', ');
    html('h3', this.#host).textContent =
      `${run.filter}: ${modules || 'all'} on ${trainingData(run)}`;
    const success = result?.success ?? null;
    html('.statement', this.#host).textContent = statement(settings.success, success);
    const { no_change: noChange = '' } = result?.finetuned ?? {};
    const verdict = [success?.verdict, noChange || (success ? '' : result?.comparison.verdict)];
    this.showVerdict(result ? verdict.filter(Boolean).join(' ') : stateText(job));
    html('.verdict', this.#host).dataset.outcome = success
      ? outcomeView(success.outcome, notExcluded(success)).tone
      : '';
    this.#drawSlices(success);
    const isPaused = job?.state === 'cancelled';
    const isComplete = Boolean(result && run.finetuned);
    const state = result ? 'measuring' : active || isPaused ? 'active' : 'ended';
    this.#host.dataset.state = isComplete ? 'ready' : state;
    const controls = html('.doing', this.#host);
    controls.hidden = isComplete;
    const bar = element('progress', HTMLProgressElement, controls);
    bar.hidden = !active;
    bar.value = job?.progress ?? 0;
    const button = html('button', controls);
    button.textContent = active ? 'Pause' : 'Resume';
    button.title = active ? RESUMES : '';
    this.#drawDecision(run);
    const task = this.#store.task(run.task);
    this.#progress.show(progress && task ? progressFigures(progress, task, settings) : null, null);
    const comparison = JSON.stringify(result?.comparison ?? null);
    if (comparison !== this.#comparison) this.#report.show(result?.comparison ?? null, null);
    this.#comparison = comparison;
    this.#drawEvents(run, isComplete ? (result?.events ?? []) : [], task);
  }

  /** @param {Success | null} success */
  #drawSlices(success) {
    const table = element('.slices', HTMLTableElement, this.#host);
    table.hidden = !success;
    if (!success) return;
    const titles = ['slice of held-out episodes', 'before', 'after', 'change', 'limit', ''];
    const beyond = notExcluded(success);
    const rows = success.slices.map((slice, i) => {
      const { before, after, unit, limit } = slice;
      const { text, tone } = outcomeView(
        slice.outcome,
        beyond.filter((other) => other === slice),
      );
      const values = [before, after].map((value) => withUnit(significant(value), unit));
      const bound = `${i ? '≤ +' : '≤ −'}${percent(Math.abs(Number(limit)))}`;
      const texts = [displayName(slice.slice), ...values, changeText(slice), bound, text];
      const cells = texts.map((textContent) => create('td', { textContent }));
      cells[5].dataset.outcome = tone;
      return create('tr', {}, ...cells);
    });
    const headings = titles.map((title) => columnHeading(title));
    fillTable(table, headings, rows);
  }

  /** @param {string} text */
  showVerdict(text) {
    html('.verdict', this.#host).textContent = typeset(text);
  }

  /** @param {FineTuneDetails} run */
  #drawDecision({ finetuned: name, saved_as: place, result, settings }) {
    const { success } = result ?? {};
    const outcome = success && outcomeView(success.outcome, notExcluded(success)).tone;
    const primary = outcome === 'met' ? 'promote' : '';
    const host = html('.decide', this.#host);
    host.hidden = !result;
    if (!result) return;
    if (!name) return host.replaceChildren(MEASURING);
    const { best_step: best, steps, seconds, no_change: noChange } = result.finetuned;
    const training = `${name}: step ${best} of ${steps}, trained in ${fixed(seconds, 0)} s.`;
    const text = place ? SAVED_AS[place] : `${training} ${NOT_SAVED}`;
    host.replaceChildren(
      this.#decisionButton(
        'promote',
        promoteText(outcome),
        'Use it as the default filter of this server',
        place === 'default' || Boolean(noChange),
        primary,
      ),
      this.#decisionButton(
        'save',
        'Save',
        'Add it to the catalog',
        place === 'saved' || Boolean(noChange),
      ),
      this.#decisionButton('discard', 'Discard', 'Remove it from the catalog', place === null),
      ...(success && success.outcome !== 'met' ? [this.#longerButton(2 * settings.steps)] : []),
      create('span', { textContent: text }),
    );
  }

  /** @param {number} steps */
  #longerButton(steps) {
    const title = `Fine-tune the base checkpoint again, with ${steps} steps; this run is kept`;
    return createButton('text', 'Train longer', this.#handlers.trainLonger, { title });
  }

  /**
   * @param {Decision} decision
   * @param {string} text
   * @param {string} title
   * @param {boolean} disabled
   * @param {string} [primary] decision
   */
  #decisionButton(decision, text, title, disabled, primary) {
    const className = decision === primary ? 'text primary' : 'text';
    const decide = () => this.#handlers.decide(decision);
    return createButton(className, text, decide, { title, disabled });
  }

  /**
   * @param {FineTuneDetails} run
   * @param {RegressionEvent[]} events
   * @param {Task | undefined} task
   */
  #drawEvents(run, events, task) {
    const host = html('.events', this.#host);
    host.hidden = !events.length;
    html('ol', host).replaceChildren(
      ...events.map((event) => {
        const { episode, step, only, slice, contact, before, after } = event;
        const comparison = only.length ? `${only.join(' + ')} only` : 'the base checkpoint';
        const link = create('a', {
          href: `/${event.link}`,
          textContent: `episode ${episode}, step ${step}`,
          title: `Open with the fine-tuned checkpoint, compared with ${comparison}`,
        });
        link.addEventListener('click', (click) => {
          if (run.saved_as) return;
          click.preventDefault();
          this.#handlers.decide('save', link.href); // the link needs it in the catalog
        });
        const errors = [before, after].map((error) => (task ? mainText(task, error) : ''));
        const text = ` ${slice}${contact ? ', contact' : ''}: ${errors.join(' → ')}`;
        return create('li', {}, link, text);
      }),
    );
  }
}

/**
 * Returns the text of the button that promotes a checkpoint, with the outcome of a criterion that is not clearly met.
 * @param {string | null | undefined} outcome
 */
export function promoteText(outcome) {
  const reasons = new Map([
    ['not met', 'criterion not met'],
    ['inconclusive', 'criterion inconclusive'],
    ['not excluded', 'regression not excluded'],
  ]);
  const reason = reasons.get(outcome ?? '');
  return `Promote to default${reason ? ` (${reason})` : ''}`;
}

/** @param {Job | null} job */
function stateText(job) {
  if (!job) return `The job was removed. ${RESUMES}`;
  return job.state === 'cancelled' ? `Paused. ${RESUMES}` : jobSummary(job);
}

/**
 * Returns the criterion in words; before the result only its slice and limits are known.
 * @param {string | null | undefined} text
 * @param {Success | null} success
 */
function statement(text, success) {
  if (!text) return 'This run has no success criterion.';
  if (success) return `Criterion: ${success.statement}`;
  return `Criterion: ${criterionText(text)}.`;
}

/**
 * Returns plots of the change of the error in each slice, with the limits of the criterion, and of the training loss.
 * @param {FineTuneProgress} progress
 * @param {Task} task
 * @param {FineTuneSettings} settings
 * @returns {ResultViews}
 */
function progressFigures({ losses, validations, steps }, task, settings) {
  const { key } = task.main;
  const names = validations.length ? Object.keys(validations[0].slices) : [];
  const slice = criterionSlice(settings);
  const x = validations.map(({ step }) => step);
  const errors = names.map((name) => ({
    name: displayName(name),
    layer: name === slice ? 'fused' : '',
    x,
    y: changes(validations, name, key),
  }));
  const { by, others } = limits(settings.success ?? '');
  /** @type {Plot['lines']} */
  const bounds = names.includes(slice)
    ? [
        { name: `limit of ${displayName(slice)}`, layer: 'fused', x: [0, steps], y: [-by, -by] },
        { name: 'limit of the others', layer: 'truth', x: [0, steps], y: [others, others] },
      ]
    : [];
  const loss = {
    name: '',
    layer: '',
    x: [0, ...losses.map(([step]) => step), steps], // the same steps as above
    y: [null, ...losses.map(([, value]) => value), null],
  };
  const plots = [
    linePlot('Validation episodes', `change of the ${task.main.name} error, %`, [
      ...errors,
      ...bounds,
    ]),
    linePlot('Loss', '', losses.length ? [loss] : []),
  ];
  return plotViews(plots.filter(({ lines }) => lines.length));
}
