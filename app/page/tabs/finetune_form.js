/** Form for a fine-tuning run: a weakness, the modules and data to train, and the criterion of success. */

/** @import { Store } from '../core/state.js' */
/** @import { FineTuneOffer, FineTuneSettings, Weakness } from '../types/server.js' */
/** @import { FaultDialog } from '../widgets/fault_dialog.js' */

import { CLEAN_WEIGHT } from '../core/constants.js';
import { create, element, html, setOptions } from '../core/dom.js';
import { displayName } from '../core/units.js';
import { criterionSlice, presetName } from './finetune_runs.js';
import { ModuleDiagram } from './module_diagram.js';
import { SliceFields } from './slice_fields.js';
import { showWeaknesses } from './weakness_list.js';

/** @typedef {Omit<FineTuneSettings, 'mix'> & {mix?: object[]}} FineTuneRequest */
/** @typedef {'clean_weight' | 'steps' | 'length' | 'rate' | 'l2_sp' | 'seed'} NumberName */

const BELIEF = new Set(['nll', 'nees']); // measures that are not errors
const CUSTOM = 'custom'; // value of a preset without a name
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
  #store;
  #diagram;
  #slice;
  /** @type {FineTuneOffer | null} */
  #offer = null;
  /** Settings of the selected weakness, or the defaults. @type {FineTuneSettings | null} */
  #suggested = null;
  #hasOwnCriterion = false; // whether the slice of the criterion was chosen by the user

  /**
   * @param {HTMLFormElement} form
   * @param {Store} store
   * @param {FaultDialog} faultDialog
   * @param {(settings: FineTuneRequest) => void} submit
   */
  constructor(form, store, faultDialog, submit) {
    this.#form = form;
    this.#store = store;
    const body = document.createElement('template');
    body.innerHTML = BODY;
    form.prepend(body.content);
    this.#diagram = new ModuleDiagram(html('.diagram', form), () => {
      this.#select('preset').value = CUSTOM;
      this.#showCount();
    });
    html('.numbers', form).append(...NUMBERS.map(numberField));
    this.#slice = new SliceFields(form, store, faultDialog, () => this.#weightClean());
    this.#select('preset').addEventListener('change', () => this.#applyPreset());
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
    const { modules, presets, measures, simulated } = offer;
    this.#diagram.show(modules, presets.find(({ name }) => name === 'all')?.trains ?? []);
    setOptions(this.#select('preset'), [
      ...presets.map(({ name }) => [name, presetName(displayName(name))]),
      [CUSTOM, 'custom'],
    ]);
    this.#slice.show(
      offer,
      weaknesses.flatMap(({ slices }) => slices),
    );
    setOptions(
      this.#select('measure'),
      measures.map(({ name, title }) => [name, BELIEF.has(name) ? title : `${title} error`]),
    );
    html('.simulated', this.#form).textContent = simulated
      ? `${simulated} training episodes are simulated first, once: the sample set has test episodes only.`
      : '';
    const suggest = (/** @type {FineTuneSettings} */ settings) => this.#suggest(settings);
    showWeaknesses(html('.weakness', this.#form), this.#store, weaknesses, suggest);
    this.#suggest(weaknesses[0]?.settings ?? offer.settings);
  }

  /**
   * Sets all fields.
   * @param {FineTuneSettings} settings
   */
  #suggest(settings) {
    this.#suggested = settings;
    this.#hasOwnCriterion = false;
    this.#select('preset').value = settings.train[0] ?? 'all';
    for (const { name } of NUMBERS) this.#input(name).value = String(settings[name]);
    this.#applyPreset();
    this.#slice.choose(settings.mix[0]?.slice.name ?? '');
    this.#offerCriterion();
    const slice = criterionSlice(settings);
    this.#select('measure').value = settings.success?.match(/:measure=([^:]*)/)?.[1] ?? 'error';
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

  /** Offers the trained slice and the standard ones for the criterion. */
  #offerCriterion() {
    const select = this.#select('criterion');
    const trained = this.#slice.name;
    const names = [...new Set([trained, ...(this.#offer?.criterion_slices ?? [])])];
    const isKept = this.#hasOwnCriterion && names.includes(select.value);
    setOptions(
      select,
      names.map((name) => [name, displayName(name)]),
      isKept ? select.value : trained,
    );
  }

  /** Sets the weight of clean data to that of the suggested slice, or to that of any other one. */
  #weightClean() {
    const { mix, clean_weight: weight } = this.#suggested ?? {
      mix: [],
      clean_weight: CLEAN_WEIGHT,
    };
    const isSuggested = mix[0]?.slice.name === this.#slice.name;
    this.#input('clean_weight').value = String(isSuggested ? weight : CLEAN_WEIGHT);
    this.#offerCriterion();
  }

  /** @returns {FineTuneRequest} */
  #settings() {
    const preset = this.#select('preset').value;
    const numbers = NUMBERS.map(({ name }) => [name, Number(this.#input(name).value)]);
    /** @type {FineTuneRequest} */
    const settings = {
      .../** @type {Record<NumberName, number>} */ (Object.fromEntries(numbers)),
      train: preset === CUSTOM ? this.#diagram.trained : [preset],
      events: this.#input('events')
        .value.split(/[\s,]+/)
        .filter(Boolean),
    };
    const [measure, criterion] = [this.#select('measure').value, this.#select('criterion').value];
    const limits = `by=${this.#input('by').value}%:others=${this.#input('others').value}%`;
    settings.success = `${criterion}:measure=${measure}:${limits}`;
    const slice = this.#slice.definition;
    if (slice) settings.mix = [{ slice, share: 1 }];
    return settings;
  }
}

/** @param {typeof NUMBERS[number]} field */
function numberField({ name, text, step, title }) {
  const input = create('input', { type: 'number', name, step: String(step), min: '0' });
  return create('label', { title }, `${text} `, input);
}
