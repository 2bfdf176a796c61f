/** The form that says what the other run is: another filter, other sensors, or an edit of this run over some steps. */

import { choice } from '../widgets/pickers.js';
import { faultPicker } from '../widgets/fault_dialog.js';
import { fixed, sentence } from '../core/units.js';

const KINDS = [
  ['filter', 'another filter'],
  ['faults', 'other sensors'],
  ['edit', 'an edit of some steps'],
];
const FIRST_SPAN = 20; // steps of an edit, until somebody chooses others

/** `a=1&b=2`, as an address has it, with as few signs escaped as can be. */
const joined = (pairs) =>
  pairs
    .map(([key, value]) => `${key}=${String(value).replace(/[%&+#]/g, encodeURIComponent)}`)
    .join('&');

/** What an other run is: `filter`, `faults` or `edit`. @param {string} against as in the state */
const kindOf = (against) => {
  const asked = new URLSearchParams(against);
  return asked.has('from')
    ? 'edit'
    : asked.has('faults') && !asked.has('filter')
      ? 'faults'
      : 'filter';
};

export class Edit {
  #form;
  #store;
  #catalog;
  #trace = null;
  #kind = 'filter';
  #faults = '';
  #editFaults = '';
  /** @type {Map<string, number>} modality to beta, those set by hand, the newest last */
  #held = new Map();
  #showFaults;
  #showEditFaults;

  /**
   * @param {HTMLFormElement} form @param {import('../data/api.js').Catalog} catalog @param {import('../core/state.js').Store} store
   * @param {import('../widgets/fault_dialog.js').FaultDialog} sheet
   * @param {(against: string) => Promise<unknown>} check raises what is wrong with an other run
   */
  constructor(form, catalog, store, sheet, check) {
    [this.#form, this.#catalog, this.#store] = [form, catalog, store];
    const pick = (name, set, of) =>
      faultPicker(form.elements[name], sheet, {
        ...of,
        choose: (faults) => (set(faults), this.#tell('')),
      });
    this.#showFaults = pick('faults', (faults) => (this.#faults = faults), {
      none: 'as recorded',
      chosen: () => this.#faults,
      check: (faults) => faults && check(joined([['faults', faults]])),
    });
    this.#showEditFaults = pick('edit_faults', (faults) => (this.#editFaults = faults), {
      none: 'as they are',
      chosen: () => this.#editFaults,
      check: (faults) => faults && check(joined([...this.#span, ['faults', faults]])),
    });
    form.addEventListener('submit', (event) => (event.preventDefault(), this.#run()));
    form.addEventListener('input', () => this.#tell(''));
    form.querySelector('.clear').addEventListener('click', () => store.set({ against: '' }));
    form
      .querySelector('.release')
      .addEventListener('click', () => (this.#held.clear(), this.#showBetas()));
    for (const name of ['from', 'last'])
      form.elements[name].addEventListener('change', () => this.#showBetas());
  }

  /** Another trace, or another other run, from a link or undone: the form says what is so. @param {import('../data/trace.js').Trace} trace */
  show(trace) {
    const fresh = !this.#trace || this.#trace.steps !== trace.steps;
    this.#trace = trace;
    const { against, filter, task: name } = this.#store.state;
    const task = this.#catalog.tasks.find((t) => t.name === name);
    const others = task.filters.filter((f) => f.name !== filter).map((f) => f.name);
    const fields = this.#form.elements;
    fields.filter.replaceChildren(...others.map((other) => new Option(other, other)));
    for (const field of ['from', 'last']) fields[field].max = String(trace.steps - 1);
    if (fresh) this.#setSpan(this.#store.state.step, this.#store.state.step + FIRST_SPAN - 1);
    for (const held of this.#held.keys())
      if (!trace.modalities.includes(held)) this.#held.delete(held);
    if (against) this.#read(against);
    else if (!others.length && this.#kind === 'filter') this.#kind = 'edit';
    this.#form.querySelector('.clear').disabled = !against;
    this.#showFaults(task.fault_presets);
    this.#showEditFaults(task.fault_presets);
    this.#buildBetas();
    this.#showKind(others);
  }

  /** One end of the edit is here, the form shows edits. @param {'from' | 'last'} end */
  mark(end, step) {
    if (!this.#trace) return;
    const at = { from: this.#step('from'), last: this.#step('last'), [end]: step };
    if (at.from > at.last)
      at[end === 'from' ? 'last' : 'from'] =
        end === 'from' ? step + FIRST_SPAN - 1 : Math.max(0, step - FIRST_SPAN + 1);
    this.#setSpan(at.from, at.last);
    this.#kind = 'edit';
    this.#showKind();
    this.#showBetas();
  }

  /** What the state says, into the fields. */
  #read(against) {
    const asked = new URLSearchParams(against);
    this.#kind = kindOf(against);
    const { filter } = this.#form.elements;
    if ([...filter.options].some(({ value }) => value === asked.get('filter')))
      filter.value = asked.get('filter');
    if (this.#kind === 'faults') this.#faults = asked.get('faults');
    if (this.#kind !== 'edit') return;
    this.#setSpan(Number(asked.get('from')), Number(asked.get('to')) - 1);
    this.#editFaults = asked.get('faults') ?? '';
    const pairs = (asked.get('weights') ?? '')
      .split(',')
      .filter(Boolean)
      .map((part) => part.split('='));
    this.#held = new Map(pairs.map(([name, beta]) => [name, Number(beta)]));
  }

  get #span() {
    return [
      ['from', this.#step('from')],
      ['to', this.#step('last') + 1],
    ];
  }

  #step(field) {
    return this.#form.elements[field].valueAsNumber;
  }

  #setSpan(from, last) {
    const most = this.#trace.steps - 1;
    this.#form.elements.from.value = String(Math.min(from, most));
    this.#form.elements.last.value = String(Math.min(last, most));
  }

  #run() {
    const against = this.#text();
    if (against) this.#store.set({ against, playing: false });
  }

  /** The other run as the fields have it; empty, with the reason said, where they have none. */
  #text() {
    const { filter, from, last } = this.#form.elements;
    if (this.#kind === 'filter')
      return filter.value
        ? joined([['filter', filter.value]])
        : this.#tell('There is no other filter of this task.');
    if (this.#kind === 'faults') {
      return this.#faults === this.#store.state.faults
        ? this.#tell('This run has these sensors. Choose others.')
        : joined([['faults', this.#faults]]);
    }
    if (!(from.valueAsNumber <= last.valueAsNumber))
      return this.#tell('The last step of the edit comes before its first.');
    const weights = [...this.#held].map(([name, beta]) => `${name}=${beta}`).join(',');
    if (!this.#editFaults && !weights)
      return this.#tell(
        'Nothing is edited yet: choose how the sensors are broken, or move a weight.',
      );
    return joined([
      ...this.#span,
      ...(this.#editFaults ? [['faults', this.#editFaults]] : []),
      ...(weights ? [['weights', weights]] : []),
    ]);
  }

  #tell(line) {
    this.#form.querySelector('.error').textContent = line;
    return '';
  }

  #showKind(others = [...this.#form.elements.filter.options]) {
    choice(
      this.#form.querySelector('#against-kind'),
      KINDS,
      this.#kind,
      (kind) => ((this.#kind = kind), this.#showParts()),
    );
    this.#form.querySelector('[data-kind="filter"] .why-not').textContent = others.length
      ? ''
      : 'There is no other filter of this task: give one to the server with --filter.';
    this.#form.elements.filter.disabled = !others.length;
    this.#showParts();
  }

  #showParts() {
    this.#tell('');
    for (const part of this.#form.querySelectorAll('[data-kind]'))
      part.hidden = part.dataset.kind !== this.#kind;
    const external = this.#trace.header.kind === 'external';
    const refused =
      external &&
      `${this.#trace.header.filter} is a filter from outside, whose steps cannot be taken again one by one: it cannot be edited.`;
    this.#form.querySelector('[data-kind="edit"] > .why-not').textContent = refused
      ? sentence(refused)
      : '';
    this.#form.querySelector('.betas').hidden = external;
    for (const field of this.#form.querySelectorAll('[data-kind="edit"] :is(input, select)'))
      field.disabled = external;
    this.#form.querySelector('.run').disabled =
      (this.#kind === 'edit' && external) ||
      (this.#kind === 'filter' && this.#form.elements.filter.disabled);
  }

  /** A slider for each modality, where the filter weighs them by beta. */
  #buildBetas() {
    const trace = this.#trace;
    const weighed = trace.has('weights') && trace.header.kind !== 'external';
    this.#form.querySelector('.betas .why-not').textContent =
      weighed || trace.header.kind === 'external'
        ? ''
        : `${sentence(trace.header.filter).slice(0, -1)} weighs nothing by beta, so there is none to set.`;
    if (!weighed) this.#held.clear();
    this.#form.querySelector('.sliders').replaceChildren(
      ...(weighed ? trace.modalities : []).map((name) => {
        const label = document.createElement('label');
        const input = Object.assign(document.createElement('input'), {
          type: 'range',
          min: '0',
          max: '1',
          step: '0.01',
        });
        input.dataset.modality = name;
        input.addEventListener('input', () => this.#hold(name, input.valueAsNumber));
        label.append(`β ${name}`, input, document.createElement('output'));
        return label;
      }),
    );
    this.#showBetas();
  }

  /** A weight set by hand. One modality is always left to take the rest; no sum is above one. */
  #hold(name, beta) {
    this.#held.delete(name);
    if (this.#held.size === this.#trace.modalities.length - 1)
      this.#held.delete(this.#held.keys().next().value);
    const others = [...this.#held.values()].reduce((a, b) => a + b, 0);
    this.#held.set(name, Number(Math.min(beta, 1 - others).toFixed(2)));
    this.#showBetas();
  }

  /** Those by hand; the others share the rest as the network would have it, on average over the steps. */
  #showBetas() {
    const sliders = [...this.#form.querySelectorAll('.sliders input')];
    const rest = 1 - [...this.#held.values()].reduce((a, b) => a + b, 0);
    const usual = new Map(
      sliders.map(({ dataset: { modality } }) => [modality, this.#usual(modality)]),
    );
    const free = [...usual]
      .filter(([name]) => !this.#held.has(name))
      .reduce((sum, [, beta]) => sum + beta, 0);
    for (const input of sliders) {
      const { modality } = input.dataset;
      const held = this.#held.has(modality);
      const beta = held
        ? this.#held.get(modality)
        : free > 0
          ? (rest * usual.get(modality)) / free
          : 0;
      if (document.activeElement !== input || held) input.value = String(beta);
      input.parentElement.classList.toggle('held', held);
      input.parentElement.querySelector('output').textContent =
        `${fixed(beta, 2)} ${held ? 'by hand' : this.#held.size ? 'the rest' : 'the network’s'}`;
    }
    this.#form.querySelector('.release').hidden = !this.#held.size;
  }

  /** Mean of the network's beta over the edited steps, first component. */
  #usual(modality) {
    const beta = this.#trace
      .weight('raw', modality, 0)
      .slice(this.#step('from') || 0, (this.#step('last') || 0) + 1);
    return beta.length ? beta.reduce((a, b) => a + b, 0) / beta.length : 0;
  }
}
