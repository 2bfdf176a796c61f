/** Form for a fine-tuning: a weakness, the modules and data to train, and the criterion of success. */

/** @import { Store } from '../core/state.js' */
/** @import { Catalog, FineTuneOffer, FineTuneRunInfo, FineTuneSettings, SliceInfo, Weakness } from '../types/server.js' */
/** @import { FaultDialog } from '../widgets/fault_dialog.js' */

import { CLEAN_WEIGHT } from '../core/constants.js';
import { create, element, html } from '../core/dom.js';
import { displayName, typeset } from '../core/units.js';
import { checkSelection } from '../data/api.js';
import { faultPicker } from '../widgets/fault_dialog.js';
import { ModuleDiagram } from './module_diagram.js';

/** @typedef {Omit<FineTuneSettings, 'mix'> & {mix?: object[]}} FineTuneRequest */
/** @typedef {'clean_weight' | 'steps' | 'length' | 'rate' | 'l2_sp' | 'seed'} NumberName */

const CLEAN = 'clean'; // name of the slice of clean data
const BELIEF = new Set(['nll', 'nees']); // measures that are not errors
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
  <section class="part weakness" aria-labelledby="weakness-title">
    <h4 id="weakness-title"><b>1</b> Weakness</h4>
    <div class="list" role="radiogroup" aria-labelledby="weakness-title"></div>
    <p class="none">No known weakness. Diagnose a run or search for failures to find one.</p>
  </section>
  <section class="part modules" aria-labelledby="modules-title">
    <h4 id="modules-title"><b>2</b> What to train</h4>
    <div class="row"><label>Train <select name="preset"></select></label> <span class="count"></span></div>
    <p class="help"></p>
    <div class="diagram" role="group" aria-label="Modules"></div>
    <p class="legend-of-modules"><i class="trained"></i>trained <i class="frozen"></i>frozen, verified by hash. Click a module to change it.</p>
  </section>
  <section class="part data" aria-labelledby="data-title">
    <h4 id="data-title"><b>3</b> Data and success criterion</h4>
    <div class="row">
      <label title="Data slice to train on">Train on <select name="slice"></select></label>
      <label>Faults <select name="faults"></select></label>
    </div>
    <details><summary>More settings</summary>
      <div class="row">
        <label class="phase" title="Steps of an episode that contribute to the loss">Steps <select name="contact"></select></label>
        <label title="Modalities whose measurements the filter uses">Modalities <select name="only"></select></label>
      </div>
      <div class="row numbers"></div>
      <div class="row"><label title="Restricts the slice to episodes, or to steps of them. Empty: all training episodes">Only episodes, steps <input name="events" placeholder="9, 31:20-60" autocomplete="off" spellcheck="false"></label></div>
    </details>
    <fieldset class="criterion"><legend>Success, set before the run</legend>
      The <select name="measure" aria-label="Measure of the success criterion"></select> in <select name="criterion" aria-label="Slice of the success criterion"></select>
      falls by at least <input type="number" name="by" min="1" max="99" step="1" value="10" aria-label="Smallest improvement, percent"> %,
      and in no other slice rises by more than <input type="number" name="others" min="0" step="1" value="5" aria-label="Largest regression, percent"> %.
    </fieldset>
    <div class="row"><button class="text start">Fine-tune</button> <span class="simulated"></span></div>
    <p class="error" role="alert"></p>
  </section>`;

export class FinetuneForm {
  #form;
  #catalog;
  #store;
  #diagram;
  #showFaults;
  /** @type {FineTuneOffer | null} */
  #offer = null;
  #faults = '';
  /** @type {Weakness[]} */
  #weaknesses = [];
  /** Settings of the selected weakness, or the defaults. @type {FineTuneSettings | null} */
  #suggested = null;
  #hasOwnCriterion = false; // whether the slice of the criterion was chosen by the user

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
    this.#diagram = new ModuleDiagram(html('.diagram', form), () => {
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
    this.#select('criterion').addEventListener('change', () => (this.#hasOwnCriterion = true));
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
   * Shows the options of a filter, and the settings for its first weakness.
   * @param {FineTuneOffer} offer
   * @param {Weakness[]} weaknesses
   */
  show(offer, weaknesses) {
    this.#offer = offer;
    this.#weaknesses = weaknesses;
    const { modules, presets, measures, simulated } = offer;
    this.#diagram.show(modules, presets.find(({ name }) => name === 'all')?.trains ?? []);
    fill(this.#select('preset'), [
      ...presets.map(({ name }) => pair(name, presetName(displayName(name)))),
      [CUSTOM, 'custom'],
    ]);
    const single = offer.slices.filter(({ only }) => only.length);
    fill(this.#select('only'), [
      ['', 'all'],
      ...single.map(({ only }) => pair(only.join('+'), `only ${only.join(' + ')}`)),
    ]);
    fill(this.#select('slice'), [
      ...this.#slices.map(({ name }) => pair(name, displayName(name))),
      ['', 'clean data only'],
      [CUSTOM, 'custom'],
    ]);
    html('.phase', this.#form).hidden = offer.slices.every(({ contact }) => contact === null);
    fill(
      this.#select('measure'),
      measures.map(({ name, title }) => pair(name, BELIEF.has(name) ? title : `${title} error`)),
    );
    html('.simulated', this.#form).textContent = simulated
      ? `${simulated} training episodes are simulated first, once: the sample set has test episodes only.`
      : '';
    html('.weakness .list', this.#form).replaceChildren(
      ...weaknesses.map((weakness, i) => this.#weakness(weakness, i)),
    );
    html('.weakness .none', this.#form).hidden = weaknesses.length > 0;
    this.#suggest(weaknesses[0]?.settings ?? offer.settings);
  }

  /** Data slices of the filter and of its weaknesses. */
  get #slices() {
    const all = [
      ...this.#weaknesses.flatMap(({ slices }) => slices),
      ...(this.#offer?.slices ?? []),
    ];
    return all.filter((slice, i) => all.findIndex(({ name }) => name === slice.name) === i);
  }

  /**
   * @param {Weakness} weakness
   * @param {number} i
   */
  #weakness({ title, evidence, episode, step, settings }, i) {
    const input = create('input', { type: 'radio', name: 'weakness', checked: !i });
    input.addEventListener('change', () => this.#suggest(settings));
    const item = create(
      'div',
      { className: 'item' },
      create('label', {}, input, create('strong', { textContent: title })),
      create('p', { textContent: typeset(evidence) }),
    );
    if (episode !== null) {
      const textContent = step === null ? `episode ${episode}` : `episode ${episode}, step ${step}`;
      const link = create('button', { type: 'button', className: 'text quiet', textContent });
      link.title = 'Show this step';
      link.addEventListener('click', () =>
        this.#store.set({ episode, step: step ?? 0, tab: 'diagnosis', playing: false }),
      );
      item.append(link);
    }
    return item;
  }

  /**
   * Sets all fields.
   * @param {FineTuneSettings} settings
   */
  #suggest(settings) {
    this.#suggested = settings;
    this.#hasOwnCriterion = false;
    this.#select('preset').value = settings.train[0] ?? 'all';
    this.#select('slice').value = settings.mix[0]?.slice.name ?? '';
    for (const { name } of NUMBERS) this.#input(name).value = String(settings[name]);
    this.#applyPreset();
    this.#applySlice();
    const [slice, ...parts] = (settings.success ?? '').split(':');
    const given = new Map(parts.map((part) => pair(...twoParts(part))));
    this.#select('measure').value = given.get('measure') ?? 'error';
    if (slice) this.#select('criterion').value = slice;
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
    if (preset) this.#diagram.choose(preset.trains);
    this.#showCount();
  }

  #showCount() {
    const name = this.#select('preset').value;
    const preset = this.#offer?.presets.find((item) => item.name === name);
    html('.help', this.#form).textContent = preset?.help ?? 'Custom selection of modules.';
    const [trained, total] = this.#diagram.count.map((count) => count.toLocaleString('en'));
    html('.count', this.#form).textContent =
      `${trained} of ${total} parameters; the others are frozen`;
  }

  /** The selected slice; undefined for a custom one, and for clean data. */
  get #slice() {
    const name = this.#select('slice').value;
    return this.#slices.find((item) => item.name === name);
  }

  /** Shows the definition of the selected slice, and makes it that of the criterion. */
  #applySlice() {
    this.#offerCriterion();
    if (this.#select('slice').value === CUSTOM) return;
    const slice = this.#slice;
    const { task } = this.#store.state;
    this.#faults = slice?.text.match(/faults=(.*?)(?=$|:contact=|:only=)/)?.[1] ?? '';
    this.#showFaults(this.#catalog.tasks.find(({ name }) => name === task)?.fault_presets ?? []);
    const contact = slice?.contact ?? null;
    this.#select('contact').value = contact === null ? '' : contact ? 'yes' : 'no';
    this.#select('only').value = slice?.only.join('+') ?? '';
  }

  /** Offers the trained slice and the standard ones for the criterion. */
  #offerCriterion() {
    const select = this.#select('criterion');
    const trained = this.#trainedSlice;
    const names = [...new Set([trained, ...(this.#offer?.criterion_slices ?? [])])];
    const chosen = select.value;
    fill(
      select,
      names.map((name) => pair(name, displayName(name))),
    );
    select.value = this.#hasOwnCriterion && names.includes(chosen) ? chosen : trained;
  }

  /** Name of the slice to train on. */
  get #trainedSlice() {
    const slice = this.#slice?.name;
    if (slice) return slice;
    const [contact, only] = [this.#select('contact').value, this.#select('only').value];
    if (this.#select('slice').value !== CUSTOM || !(this.#faults || contact || only)) return CLEAN;
    return customSlice(this.#faults, contact, only).split(':')[0];
  }

  /** Sets the weight of clean data to that of the suggested slice, or to that of any other one. */
  #weightClean() {
    const { mix, clean_weight: weight } = this.#suggested ?? {
      mix: [],
      clean_weight: CLEAN_WEIGHT,
    };
    const isSuggested = mix[0]?.slice.name === this.#select('slice').value;
    this.#input('clean_weight').value = String(isSuggested ? weight : CLEAN_WEIGHT);
    this.#offerCriterion();
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
      train: preset === CUSTOM ? this.#diagram.trained : [preset],
      events: this.#input('events')
        .value.split(/[\s,]+/)
        .filter(Boolean),
    };
    const [measure, criterion] = [this.#select('measure').value, this.#select('criterion').value];
    const limits = `by=${this.#input('by').value}%:others=${this.#input('others').value}%`;
    settings.success = `${criterion}:measure=${measure}:${limits}`;
    const [contact, only] = [this.#select('contact').value, this.#select('only').value];
    const slice = this.#slice;
    if (slice) settings.mix = [{ slice: definition(slice), share: 1 }];
    else if (this.#select('slice').value === CUSTOM && (this.#faults || contact || only))
      settings.mix = [{ slice: customSlice(this.#faults, contact, only), share: 1 }];
    return settings;
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
 * Splits `key=value`.
 * @param {string} text
 * @returns {[key: string, value: string]}
 */
const twoParts = (text) => [text.split('=')[0], text.split('=')[1] ?? ''];

/**
 * @param {HTMLSelectElement} select
 * @param {[value: string, text: string][]} options
 */
function fill(select, options) {
  select.replaceChildren(...options.map(([value, text]) => new Option(text, value)));
}
