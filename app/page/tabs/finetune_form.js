/** Form for a fine-tuning: trained modules, training data and optimiser settings. */

/** @import { Store } from '../core/state.js' */
/** @import { Catalog, FineTuneOffer, FineTuneRunInfo, FineTuneSettings, SliceInfo } from '../types/server.js' */
/** @import { FaultDialog } from '../widgets/fault_dialog.js' */

import { CLEAN_WEIGHT } from '../core/constants.js';
import { create, element, html } from '../core/dom.js';
import { displayName } from '../core/units.js';
import { checkSelection } from '../data/api.js';
import { faultPicker } from '../widgets/fault_dialog.js';
import { ModuleTree } from './module_tree.js';

/** @typedef {Omit<FineTuneSettings, 'mix'> & {mix?: object[]}} FineTuneRequest */
/** @typedef {'clean_weight' | 'steps' | 'length' | 'rate' | 'l2_sp' | 'seed'} NumberName */

const CUSTOM = 'custom'; // value of a preset or a slice without a name
/** @type {[string, string][]} */
const PHASES = [
  ['', 'all steps'],
  ['yes', 'contact'],
  ['no', 'free motion'],
];
/** @type {{name: NumberName, text: string, step: number | 'any', title: string}[]} */
const NUMBERS = [
  {
    name: 'clean_weight',
    text: 'Weight of clean data',
    step: 0.01,
    title: 'Weight of clean data in the loss, which preserves the accuracy elsewhere',
  },
  { name: 'steps', text: 'Training steps', step: 1, title: 'Maximum number of optimiser steps' },
  { name: 'length', text: 'Window, steps', step: 1, title: 'Length of the training sequences' },
  { name: 'rate', text: 'Learning rate', step: 'any', title: 'Learning rate of Adam' },
  {
    name: 'l2_sp',
    text: 'L2-SP strength',
    step: 'any',
    title: 'Strength of the decay towards the weights of the base checkpoint',
  },
  { name: 'seed', text: 'Seed', step: 1, title: 'Seed of all random numbers' },
];

const BODY = `
  <p class="reason"></p>
  <div class="row"><label>Train <select name="preset"></select></label> <span class="count"></span></div>
  <ul class="tree" aria-label="Modules"></ul>
  <div class="row">
    <label title="Data slice to train on; its definition is shown on the right">Train on <select name="slice"></select></label>
    <label>Sensors <select name="faults"></select></label>
    <label class="phase" title="Steps of an episode that contribute to the loss">Steps <select name="contact"></select></label>
    <label title="Modalities whose measurements the filter uses">Modalities <select name="only"></select></label>
  </div>
  <div class="row numbers"></div>
  <div class="row"><label title="Restricts the slice to episodes, or to steps of them. Empty: all training episodes">Only episodes, steps <input name="events" placeholder="9, 31:20-60" autocomplete="off" spellcheck="false"></label></div>
  <div class="row"><button class="text start">Fine-tune</button> <label class="past" hidden>Previous runs <select name="past"></select></label></div>
  <p class="error" role="alert"></p>`;

export class FinetuneForm {
  #form;
  #catalog;
  #store;
  #tree;
  #showFaults;
  /** @type {FineTuneOffer | null} */
  #offer = null;
  #faults = '';

  /**
   * @param {HTMLFormElement} form
   * @param {Catalog} catalog
   * @param {Store} store
   * @param {FaultDialog} faultDialog
   * @param {(settings: FineTuneRequest) => void} submit
   */
  constructor(form, catalog, store, faultDialog, submit) {
    this.#form = form;
    this.#catalog = catalog;
    this.#store = store;
    const body = document.createElement('template');
    body.innerHTML = BODY;
    form.prepend(body.content);
    this.#tree = new ModuleTree(html('.tree', form), () => {
      this.#select('preset').value = CUSTOM;
      this.#showCount();
    });
    html('.numbers', form).append(...NUMBERS.map(numberField));
    fill(this.#select('contact'), PHASES);
    const useCustomSlice = () => {
      this.#select('slice').value = CUSTOM;
      this.#weightClean();
    };
    this.#showFaults = faultPicker(this.#select('faults'), faultDialog, {
      none: 'as recorded',
      selected: () => this.#faults,
      choose: (faults) => {
        this.#faults = faults;
        useCustomSlice();
      },
      check: (faults) => checkSelection({ ...store.state, faults, against: '' }),
    });
    for (const name of ['contact', 'only'])
      this.#select(name).addEventListener('change', useCustomSlice);
    this.#select('preset').addEventListener('change', () => this.#applyPreset());
    this.#select('slice').addEventListener('change', () => {
      this.#applySlice();
      this.#weightClean();
    });
    const past = this.#select('past');
    past.addEventListener('change', () => store.set({ run: past.value }));
    form.addEventListener('submit', (event) => {
      event.preventDefault();
      const settings = this.#settings();
      if (settings.train.length) submit(settings);
      else this.showError('No modules are selected: there is nothing to train.');
    });
  }

  set hidden(/** @type {boolean} */ hidden) {
    this.#form.hidden = hidden;
  }

  /** Moves the focus to the first field. */
  focus() {
    this.#select('preset').focus();
  }

  /** @param {string} text */
  showError(text) {
    html('.error', this.#form).textContent = text;
  }

  /**
   * Shows the options of a filter with default values.
   * @param {FineTuneOffer} offer
   */
  show(offer) {
    this.#offer = offer;
    const { modules, presets, slices, settings, reason, runs } = offer;
    html('.reason', this.#form).textContent = reason;
    this.#tree.show(modules, presets.find(({ name }) => name === 'all')?.trains ?? []);
    fill(this.#select('preset'), [
      ...presets.map(({ name }) => pair(name, displayName(name).replace('-only', ' only'))),
      [CUSTOM, 'custom'],
    ]);
    this.#select('preset').value = settings.train[0] ?? 'all';
    const single = slices.filter(({ only }) => only.length);
    fill(this.#select('only'), [
      ['', 'all'],
      ...single.map(({ only }) => pair(only.join('+'), `only ${only.join(' + ')}`)),
    ]);
    fill(this.#select('slice'), [
      ...slices.map(({ name }) => pair(name, name)),
      ['', 'clean data only'],
      [CUSTOM, 'custom'],
    ]);
    html('.phase', this.#form).hidden = slices.every(({ contact }) => contact === null);
    this.#select('slice').value = settings.mix[0]?.slice.name ?? '';
    for (const { name } of NUMBERS) this.#input(name).value = String(settings[name]);
    html('.past', this.#form).hidden = !runs.length;
    fill(this.#select('past'), [
      ['', 'select …'],
      ...runs.map((run) => pair(run.run, runTitle(run))),
    ]);
    this.#applyPreset();
    this.#applySlice();
  }

  /** @param {string} name */
  #select(name) {
    return element(`select[name=${name}]`, HTMLSelectElement, this.#form);
  }

  /** @param {string} name */
  #input(name) {
    return element(`input[name=${name}]`, HTMLInputElement, this.#form);
  }

  #applyPreset() {
    const name = this.#select('preset').value;
    const preset = this.#offer?.presets.find((item) => item.name === name);
    if (preset) this.#tree.choose(preset.trains);
    this.#showCount();
  }

  #showCount() {
    const [trained, total] = this.#tree.count.map((count) => count.toLocaleString('en'));
    html('.count', this.#form).textContent =
      `${trained} of ${total} parameters; the others are frozen`;
  }

  /** The selected slice; undefined for a custom one, and for clean data. */
  get #slice() {
    const name = this.#select('slice').value;
    return this.#offer?.slices.find((item) => item.name === name);
  }

  /** Shows the definition of the selected slice. */
  #applySlice() {
    if (this.#select('slice').value === CUSTOM) return;
    const slice = this.#slice;
    const { task } = this.#store.state;
    this.#faults = slice?.text.match(/faults=(.*?)(?=$|:contact=|:only=)/)?.[1] ?? '';
    this.#showFaults(this.#catalog.tasks.find(({ name }) => name === task)?.fault_presets ?? []);
    const contact = slice?.contact ?? null;
    this.#select('contact').value = contact === null ? '' : contact ? 'yes' : 'no';
    this.#select('only').value = slice?.only.join('+') ?? '';
  }

  /** Sets the weight of clean data: the default slice has a weight of its own. */
  #weightClean() {
    const { mix, clean_weight } = this.#offer?.settings ?? { mix: [], clean_weight: CLEAN_WEIGHT };
    const isDefault = mix[0]?.slice.name === this.#select('slice').value;
    this.#input('clean_weight').value = String(isDefault ? clean_weight : CLEAN_WEIGHT);
  }

  /** @returns {FineTuneRequest} */
  #settings() {
    const preset = this.#select('preset').value;
    /** @param {NumberName} name */
    const number = (name) => Number(this.#input(name).value);
    /** @type {FineTuneRequest} */
    const settings = {
      clean_weight: number('clean_weight'),
      steps: number('steps'),
      length: number('length'),
      rate: number('rate'),
      l2_sp: number('l2_sp'),
      seed: number('seed'),
      train: preset === CUSTOM ? this.#tree.trained : [preset],
      events: this.#input('events')
        .value.split(/[\s,]+/)
        .filter(Boolean),
    };
    const [contact, only] = [this.#select('contact').value, this.#select('only').value];
    const slice = this.#slice;
    if (slice) settings.mix = [{ slice: definition(slice), share: 1 }];
    else if (this.#select('slice').value === CUSTOM && (this.#faults || contact || only))
      settings.mix = [{ slice: customSlice(this.#faults, contact, only), share: 1 }];
    return settings;
  }
}

/**
 * Returns the names of the data slices that a run was trained on.
 * @param {FineTuneRunInfo} run
 */
export const trainingData = ({ settings }) =>
  settings.mix.map(({ slice }) => slice.name).join(' and ') || 'clean data';

/** @param {FineTuneRunInfo} run */
function runTitle(run) {
  const result = run.finetuned ? ` → ${run.finetuned}` : '';
  return `${run.filter}: ${trainingData(run)}${result}`;
}

/** @param {SliceInfo} slice */
const definition = ({ name, faults, contact, only }) => ({ name, faults, contact, only });

/**
 * Returns the text of a slice, named after its definition.
 * @param {string} faults
 * @param {string} contact
 * @param {string} only
 */
function customSlice(faults, contact, only) {
  const phase = PHASES.find(([value]) => contact && value === contact)?.[1];
  const parts = [faults.replace(/[:=]/g, ' ') || 'no faults', phase, only && `${only} only`];
  const values = [`faults=${faults}`, contact && `contact=${contact}`, only && `only=${only}`];
  return [parts.filter(Boolean).join(', '), ...values].filter(Boolean).join(':');
}

/** @param {typeof NUMBERS[number]} field */
function numberField({ name, text, step, title }) {
  const input = create('input', { type: 'number', name, step: String(step), min: '0' });
  return create('label', { title }, `${text} `, input);
}

/**
 * @param {string} value
 * @param {string} text
 * @returns {[value: string, text: string]}
 */
const pair = (value, text) => [value, text];

/**
 * @param {HTMLSelectElement} select
 * @param {[value: string, text: string][]} options
 */
function fill(select, options) {
  select.replaceChildren(...options.map(([value, text]) => new Option(text, value)));
}
