/** Fields of the data slice to train on: a named one, or its faults, phase and modalities. */

/** @import { Store } from '../core/state.js' */
/** @import { FineTuneOffer, SliceInfo } from '../types/server.js' */
/** @import { FaultDialog } from '../widgets/fault_dialog.js' */

import { element, html, setOptions } from '../core/dom.js';
import { displayName } from '../core/units.js';
import { checkSelection } from '../data/api.js';
import { faultPicker } from '../widgets/fault_dialog.js';

const CLEAN = 'clean'; // name of the slice of clean data
const CUSTOM = 'custom'; // value of a slice without a name
/** @type {Record<string, string>} */
const PHASES = { '': 'all steps', yes: 'contact', no: 'free motion' };

export class SliceFields {
  #form;
  #store;
  #showFaults;
  /** @type {SliceInfo[]} */
  #slices = [];
  #faults = '';

  /**
   * @param {HTMLFormElement} form
   * @param {Store} store
   * @param {FaultDialog} faultDialog
   * @param {() => void} changed called after a change by the user
   */
  constructor(form, store, faultDialog, changed) {
    this.#form = form;
    this.#store = store;
    setOptions(this.#select('contact'), PHASES);
    const useCustomSlice = () => {
      this.#select('slice').value = CUSTOM;
      changed();
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
    this.#select('slice').addEventListener('change', () => {
      this.#showDefinition();
      changed();
    });
  }

  /** @param {string} name */
  #select(name) {
    return element(`select[name=${name}]`, HTMLSelectElement, this.#form);
  }

  /**
   * Shows the slices of a filter and of its weaknesses.
   * @param {FineTuneOffer} offer
   * @param {SliceInfo[]} others
   */
  show(offer, others) {
    const all = [...others, ...offer.slices];
    this.#slices = all.filter((slice, i) => all.findIndex(({ name }) => name === slice.name) === i);
    const single = offer.slices.filter(({ only }) => only.length);
    setOptions(this.#select('only'), [
      ['', 'all'],
      ...single.map(({ only }) => [only.join('+'), `only ${only.join(' + ')}`]),
    ]);
    setOptions(this.#select('slice'), [
      ...this.#slices.map(({ name }) => [name, displayName(name)]),
      ['', 'clean data only'],
      [CUSTOM, 'custom'],
    ]);
    html('.phase', this.#form).hidden = offer.slices.every(({ contact }) => contact === null);
  }

  /**
   * Selects a slice.
   * @param {string} name empty for clean data
   */
  choose(name) {
    this.#select('slice').value = name;
    this.#showDefinition();
  }

  /** Shows the definition of the selected slice. */
  #showDefinition() {
    if (this.#select('slice').value === CUSTOM) return;
    const slice = this.#named;
    this.#faults = slice?.text.match(/faults=(.*?)(?=$|:contact=|:only=)/)?.[1] ?? '';
    this.#showFaults(this.#store.task()?.fault_presets ?? []);
    const contact = slice?.contact ?? null;
    this.#select('contact').value = contact === null ? '' : contact ? 'yes' : 'no';
    this.#select('only').value = slice?.only.join('+') ?? '';
  }

  /** The selected slice; undefined for a custom one, and for clean data. */
  get #named() {
    const name = this.#select('slice').value;
    return this.#slices.find((item) => item.name === name);
  }

  /** Text of a custom slice, named after its definition; empty if a named one or clean data are selected. */
  get #custom() {
    const [contact, only] = [this.#select('contact').value, this.#select('only').value];
    const isCustom = this.#select('slice').value === CUSTOM && (this.#faults || contact || only);
    return isCustom ? customSlice(this.#faults, contact, only) : '';
  }

  /** Name of the slice to train on. */
  get name() {
    return (this.#named?.name ?? this.#custom.split(':')[0]) || CLEAN;
  }

  /** The slice to train on, as in the settings; null for clean data. */
  get definition() {
    if (!this.#named) return this.#custom || null;
    const { name, faults, contact, only } = this.#named;
    return { name, faults, contact, only };
  }
}

/**
 * @param {string} faults
 * @param {string} contact
 * @param {string} only
 */
function customSlice(faults, contact, only) {
  const phase = contact && PHASES[contact];
  const parts = [faults.replace(/[:=]/g, ' ') || 'no faults', phase, only && `${only} only`];
  const values = [`faults=${faults}`, contact && `contact=${contact}`, only && `only=${only}`];
  return [parts.filter(Boolean).join(', '), ...values].filter(Boolean).join(':');
}
