/** Form for the comparison run: another filter, other faults, a standalone filter, or an intervention over some steps. */

/** @import { Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { FaultDialog } from '../widgets/fault_dialog.js' */

import { create, element, html } from '../core/dom.js';
import { filtersOf, isRecordedOnly } from '../core/episodes.js';
import { displayName, fixed } from '../core/units.js';
import { sum } from '../data/arrays.js';
import { weightScope } from '../step/step_summary.js';
import { faultPicker } from '../widgets/fault_dialog.js';
import { choice } from '../widgets/pickers.js';

/** @typedef {keyof typeof KINDS} Kind of comparison */

const KINDS = {
  filter: 'another filter',
  faults: 'other sensor faults',
  only: 'one modality',
  intervention: 'an intervention',
};
const DEFAULT_SPAN = 20; // steps of an intervention

/**
 * Joins pairs to `a=1&b=2`, with as few escaped characters as possible.
 * @param {[string, string | number][]} pairs
 */
const joined = (pairs) =>
  pairs
    .map(([key, value]) => `${key}=${String(value).replace(/[%&+#]/g, encodeURIComponent)}`)
    .join('&');

/**
 * Returns the kind of a comparison.
 * @param {URLSearchParams} against
 * @returns {Kind}
 */
function kindOf(against) {
  if (against.has('from')) return 'intervention';
  if (against.has('only')) return 'only';
  return against.has('faults') && !against.has('filter') ? 'faults' : 'filter';
}

/**
 * Returns why an intervention cannot have these steps; empty if it can.
 * @param {number} first its first step
 * @param {number} to first step after it
 * @param {number} steps of the episode
 */
export function spanProblem(first, to, steps) {
  if (!(first < to))
    return 'The intervention has no steps: the step after it must be later than its first step.';
  if (to <= steps) return '';
  return `This episode has steps 0 to ${steps - 1}, so the first step after the intervention is at most ${steps}.`;
}

export class ComparisonForm {
  #form;
  #store;
  #filter;
  #only;
  #first;
  #to;
  #clearButton;
  /** @type {Trace | null} */
  #trace = null;
  /** @type {Kind} */
  #kind = 'filter';
  #faults = '';
  #editFaults = '';
  /** Weights beta that the user has set, by modality, the newest last. @type {Map<string, number>} */
  #manual = new Map();
  #showFaults;
  #showEditFaults;

  /**
   * @param {HTMLFormElement} form
   * @param {Store} store
   * @param {FaultDialog} dialog
   * @param {(against: string) => Promise<unknown>} check throws the reason if a comparison is invalid
   */
  constructor(form, store, dialog, check) {
    this.#form = form;
    this.#store = store;
    this.#filter = element('[name=filter]', HTMLSelectElement, form);
    this.#only = element('[name=only]', HTMLSelectElement, form);
    this.#first = element('[name=from]', HTMLInputElement, form);
    this.#to = element('[name=to]', HTMLInputElement, form);
    this.#clearButton = element('.clear', HTMLButtonElement, form);
    this.#showFaults = faultPicker(element('[name=faults]', HTMLSelectElement, form), dialog, {
      none: 'as recorded',
      selected: () => this.#faults,
      choose: (faults) => ((this.#faults = faults), this.#setError('')),
      check: async (faults) => faults && check(joined([['faults', faults]])),
    });
    const interventionSelect = element('[name=intervention_faults]', HTMLSelectElement, form);
    this.#showEditFaults = faultPicker(interventionSelect, dialog, {
      none: 'unchanged',
      selected: () => this.#editFaults,
      choose: (faults) => ((this.#editFaults = faults), this.#setError('')),
      check: async (faults) => faults && check(joined([...this.#span, ['faults', faults]])),
    });
    form.addEventListener('submit', (event) => (event.preventDefault(), this.#submit()));
    form.addEventListener('input', () => this.#setError(''));
    this.#clearButton.addEventListener('click', () => store.set({ against: '' }));
    html('.release', form).addEventListener('click', () => {
      this.#manual.clear();
      this.#showBetas();
    });
    for (const input of [this.#first, this.#to])
      input.addEventListener('input', () => this.#showBetas());
  }

  /**
   * Shows the comparison of the state for a trace.
   * @param {Trace} trace
   */
  show(trace) {
    const isNew = this.#trace?.steps !== trace.steps;
    this.#trace = trace;
    const { against, data, filter, step, faults } = this.#store.state;
    const task = this.#store.task();
    const filters = task ? filtersOf(task, data) : [];
    const others = filters.map((f) => f.name).filter((other) => other !== filter);
    this.#filter.replaceChildren(...others.map((other) => new Option(other, other)));
    this.#only.replaceChildren(
      ...trace.inputs.map((name) => new Option(`${displayName(name)} standalone`, name)),
    );
    [this.#first.max, this.#to.max] = [String(trace.steps - 1), String(trace.steps)];
    if (isNew) this.#setSpan(step, step + DEFAULT_SPAN);
    for (const modality of this.#manual.keys())
      if (!trace.modalities.includes(modality)) this.#manual.delete(modality);
    if (against) this.#read(new URLSearchParams(against));
    else if (!others.length && this.#kind === 'filter') this.#kind = 'intervention';
    this.#clearButton.disabled = !against;
    const presets = task?.fault_presets ?? [];
    if (!against && this.#faults === faults)
      this.#faults = faults ? '' : (presets[0]?.faults ?? '');
    this.#showFaults(presets);
    this.#showEditFaults(presets);
    this.#buildBetas(trace);
    this.#showKind();
  }

  /**
   * Lets an intervention begin at a step, or end after it.
   * @param {'from' | 'to'} end
   * @param {number} step
   */
  mark(end, step) {
    if (!this.#trace) return;
    let [first, to] = [this.#first.valueAsNumber, this.#to.valueAsNumber];
    if (end === 'from') [first, to] = [step, to <= step ? step + DEFAULT_SPAN : to];
    else [first, to] = [first > step ? Math.max(0, step - DEFAULT_SPAN + 1) : first, step + 1];
    this.#setSpan(first, to);
    this.#kind = 'intervention';
    this.#showKind();
    this.#showBetas();
  }

  /**
   * Fills the fields.
   * @param {URLSearchParams} against
   */
  #read(against) {
    this.#kind = kindOf(against);
    const filter = against.get('filter') ?? '';
    if ([...this.#filter.options].some(({ value }) => value === filter))
      this.#filter.value = filter;
    if (this.#kind === 'only') this.#only.value = against.get('only') ?? '';
    if (this.#kind === 'faults') this.#faults = against.get('faults') ?? '';
    if (this.#kind !== 'intervention') return;
    this.#setSpan(Number(against.get('from')), Number(against.get('to')));
    this.#editFaults = against.get('faults') ?? '';
    const weights = (against.get('weights') ?? '').split(',').filter(Boolean);
    this.#manual = new Map(
      weights.map((part) => {
        const [modality, beta] = part.split('=');
        return [modality, Number(beta)];
      }),
    );
  }

  /** @returns {[string, number][]} */
  get #span() {
    return [
      ['from', this.#first.valueAsNumber],
      ['to', this.#to.valueAsNumber],
    ];
  }

  /**
   * @param {number} first
   * @param {number} to first step after the intervention
   */
  #setSpan(first, to) {
    const steps = this.#trace?.steps ?? 1;
    this.#first.value = String(Math.min(first, steps - 1));
    this.#to.value = String(Math.min(to, steps));
  }

  /** First step of the intervention and first step after it. @returns {[number, number]} */
  get #steps() {
    return [this.#first.valueAsNumber, this.#to.valueAsNumber];
  }

  #submit() {
    const against = this.#against();
    if (against) this.#store.set({ against, playing: false });
  }

  /** Returns the comparison in the fields; if it is incomplete, shows the reason and returns an empty text. */
  #against() {
    if (this.#kind === 'filter') {
      const { value } = this.#filter;
      return value ? joined([['filter', value]]) : this.#setError('This task has no other filter.');
    }
    if (this.#kind === 'only') return joined([['only', this.#only.value]]);
    if (this.#kind === 'faults') {
      return this.#faults === this.#store.state.faults
        ? this.#setError('This run has these sensor faults already. Choose others.')
        : joined([['faults', this.#faults]]);
    }
    const problem = spanProblem(...this.#steps, this.#trace?.steps ?? 1);
    if (problem) return this.#setError(problem);
    const weights = [...this.#manual].map(([name, beta]) => `${name}=${beta}`).join(',');
    const pairs = this.#span.map(
      ([key, value]) => /** @type {[string, string]} */ ([key, `${value}`]),
    );
    if (this.#editFaults) pairs.push(['faults', this.#editFaults]);
    if (weights) pairs.push(['weights', weights]);
    return pairs.length > 2
      ? joined(pairs)
      : this.#setError('The intervention is empty: choose sensor faults, or move a weight slider.');
  }

  /** @param {string} message */
  #setError(message) {
    html('.error', this.#form).textContent = message;
    return '';
  }

  #showKind() {
    const hasOthers = this.#filter.options.length > 0;
    choice(html('#against-kind', this.#form), KINDS, this.#kind, (kind) => {
      this.#kind = /** @type {Kind} */ (kind);
      this.#showFields();
    });
    html('[data-kind="filter"] .why-not', this.#form).textContent = hasOthers
      ? ''
      : 'This task has no other filter. Start the server with --filter to add one.';
    this.#filter.disabled = !hasOthers;
    this.#showFields();
  }

  #showFields() {
    this.#setError('');
    /** @type {NodeListOf<HTMLElement>} */
    const parts = this.#form.querySelectorAll('[data-kind]');
    for (const part of parts) part.hidden = part.dataset.kind !== this.#kind;
    const isExternal = this.#trace?.header.kind === 'external';
    const cannotRun = isRecordedOnly(this.#store.catalog, this.#store.state)
      ? 'The filter of this run is known only from its recorded runs, so it cannot run again.'
      : '';
    html('[data-kind="intervention"] > .why-not', this.#form).textContent =
      cannotRun ||
      (isExternal
        ? 'Interventions on the page need a built-in filter. For an external filter, use beliefscope counterfactual.'
        : '');
    const noInputs = !this.#only.options.length;
    this.#only.disabled = noInputs || Boolean(cannotRun);
    html('[data-kind="only"] .why-not', this.#form).textContent =
      cannotRun ||
      (noInputs
        ? 'This filter has no separate modalities to run standalone.'
        : 'The same filter and random numbers, without the observations of all other modalities.');
    html('[data-kind="faults"] .why-not', this.#form).textContent = cannotRun;
    element('[name=faults]', HTMLSelectElement, this.#form).disabled = Boolean(cannotRun);
    html('.betas', this.#form).hidden = isExternal;
    const fields = this.#form.querySelectorAll('[data-kind="intervention"] :is(input, select)');
    for (const field of fields) field.toggleAttribute('disabled', isExternal);
    element('.run', HTMLButtonElement, this.#form).disabled =
      (this.#kind !== 'filter' && Boolean(cannotRun)) ||
      (this.#kind === 'intervention' && isExternal) ||
      (this.#kind === 'only' && noInputs) ||
      (this.#kind === 'filter' && this.#filter.disabled);
  }

  /**
   * Creates a slider for each modality if the filter has fusion weights.
   * @param {Trace} trace
   */
  #buildBetas(trace) {
    const isExternal = trace.header.kind === 'external';
    const hasWeights = trace.has('weights') && !isExternal;
    html('.betas .why-not', this.#form).textContent =
      hasWeights || isExternal ? '' : `${trace.header.filter} has no fusion weights to set.`;
    if (!hasWeights) this.#manual.clear();
    const sliders = (hasWeights ? trace.modalities : []).map((name) => {
      const input = create('input', { type: 'range', min: '0', max: '1', step: '0.01' });
      input.dataset.modality = name;
      input.addEventListener('input', () => this.#setBeta(name, input.valueAsNumber));
      return create('label', {}, `β ${displayName(name)}`, input, document.createElement('output'));
    });
    html('.sliders', this.#form).replaceChildren(...sliders);
    this.#showBetas();
  }

  /**
   * Sets a weight. One modality always remains for the rest, and the sum is at most 1.
   * @param {string} modality
   * @param {number} beta
   */
  #setBeta(modality, beta) {
    this.#manual.delete(modality);
    const [oldest] = this.#manual.keys();
    if (this.#manual.size === (this.#trace?.modalities.length ?? 0) - 1)
      this.#manual.delete(oldest);
    this.#manual.set(modality, Number(Math.min(beta, 1 - sum(this.#manual.values())).toFixed(2)));
    this.#showBetas();
  }

  /** Shows the weights; the remainder is divided in the ratio of the network's mean weights. */
  #showBetas() {
    const sliders = html('.sliders', this.#form).querySelectorAll('input');
    const remainder = 1 - sum(this.#manual.values());
    const means = new Map(
      [...sliders].map(({ dataset }) => this.#meanBeta(dataset.modality ?? '')),
    );
    const total = sum([...means].flatMap(([name, beta]) => (this.#manual.has(name) ? [] : [beta])));
    for (const input of sliders) {
      const modality = input.dataset.modality ?? '';
      const manual = this.#manual.get(modality);
      const isManual = manual !== undefined;
      const automatic = total === 0 ? 0 : (remainder * (means.get(modality) ?? 0)) / total;
      const beta = manual ?? automatic;
      if (document.activeElement !== input || isManual) input.value = String(beta || 0);
      const label = input.parentElement;
      if (!label) continue;
      label.classList.toggle('held', isManual);
      const scope = this.#trace ? weightScope(this.#trace, 0) : '';
      const origin = `${this.#manual.size ? 'remainder' : 'mean'}${scope}`;
      const output = html('output', label);
      output.textContent = `${fixed(beta, 2)} ${isManual ? 'manual' : origin}`;
      output.title = isManual ? '' : "Mean of the network's weights over these steps";
    }
    html('.release', this.#form).hidden = !this.#manual.size;
  }

  /**
   * Returns a modality and the mean of its weight over the steps of the intervention, for the first component; NaN
   * without steps.
   * @param {string} modality
   * @returns {[string, number]}
   */
  #meanBeta(modality) {
    const [first, to] = this.#steps.map((step) => step || 0);
    const beta = this.#trace?.weight('raw', modality, 0)?.slice(first, to) ?? [];
    return [modality, sum(beta) / beta.length];
  }
}
