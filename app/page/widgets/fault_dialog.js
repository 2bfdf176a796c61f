/** Sensor faults: presets, and a dialog for any other fault injection as text (docs/data.md). */

/** @import { FaultInfo, FaultPreset } from '../types/server.js' */

import { createButton, element, html, messageOf, setOptions } from '../core/dom.js';

const OTHER = 'other';

/**
 * @typedef {object} FaultTarget
 * @property {(faults: string) => Promise<unknown>} check throws the reason if the faults are invalid
 * @property {(faults: string) => void} choose applies the faults
 */

/** Dialog to edit a fault injection. Invalid faults are reported in the dialog and change nothing else. */
export class FaultDialog {
  #dialog;
  #input;
  #error;
  #steps;
  /** @type {FaultTarget | null} */
  #target = null;

  /**
   * @param {HTMLDialogElement} dialog
   * @param {FaultInfo[]} faults
   * @param {() => number | null} steps of the displayed episode; null without one
   */
  constructor(dialog, faults, steps) {
    this.#steps = steps;
    this.#dialog = dialog;
    this.#input = element('input', HTMLInputElement, dialog);
    this.#error = html('.error', dialog);
    this.#input.addEventListener('input', () => this.#setError(''));
    html('tbody', dialog).replaceChildren(...faults.map((fault) => faultRow(fault, this.#input)));
    html('form', dialog).addEventListener('submit', (event) => this.#submit(event));
  }

  /**
   * Opens the dialog.
   * @param {string} faults initial text
   * @param {FaultTarget} target
   */
  open(faults, target) {
    this.#target = target;
    this.#input.value = faults;
    this.#setError('');
    this.#dialog.showModal();
    this.#input.focus();
  }

  /** @param {SubmitEvent} event */
  async #submit(event) {
    if (event.submitter instanceof HTMLButtonElement && event.submitter.value === 'cancel') return;
    event.preventDefault();
    const faults = this.#input.value.trim();
    try {
      await this.#target?.check(faults);
    } catch (error) {
      return this.#setError(messageOf(error));
    }
    this.#target?.choose(faults);
    this.#dialog.close();
  }

  /** Shows an error, and whether faults exceed the episode. @param {string} line */
  #setError(line) {
    this.#error.textContent = line;
    const note = spanNote(this.#input.value, this.#steps());
    html('.span-note', this.#dialog).textContent = note;
  }
}

/**
 * Returns a note on faults that end after the displayed episode; other episodes may be longer, so they are valid.
 * @param {string} faults
 * @param {number | null} steps of the episode
 */
export function spanNote(faults, steps) {
  const ends = [...faults.matchAll(/:to=(\d+)/g)].map(([, to]) => Number(to));
  const beyond = ends.filter((to) => steps !== null && to > steps);
  if (steps === null || !beyond.length) return '';
  const texts = [...new Set(beyond)].map((to) => `:to=${to}`).join(', ');
  return `Note: the last step of this episode is ${steps - 1}, so ${texts} has no effect here: the fault lasts to the end.`;
}

/**
 * Whether faults are those of a preset.
 * @param {FaultPreset} preset
 * @param {string} faults
 */
export const isOfPreset = (preset, faults) => faults === preset.faults || faults === preset.stored;

/**
 * Returns the values and labels of the presets, and of other selected faults.
 * @param {FaultPreset[]} presets
 * @param {string} faults
 */
export function presetOptions(presets, faults) {
  const current = presets.find((preset) => isOfPreset(preset, faults));
  const options = presets.map((preset) => [
    preset === current ? faults : preset.faults,
    preset.name,
  ]);
  return current || !faults ? options : [...options, [faults, faults]];
}

/**
 * Connects a select element with the fault presets; its last entry opens the dialog.
 * @param {HTMLSelectElement} select
 * @param {FaultDialog} dialog
 * @param {FaultTarget & {none: string, selected: () => string}} options none: label of no faults
 * @returns {(presets: FaultPreset[]) => void} shows the presets and the selected faults
 */
export function faultPicker(select, dialog, { none, selected, choose, check }) {
  /** @type {FaultPreset[]} */
  let presets = [];
  const show = () => {
    const faults = selected();
    const options = [['', none], ...presetOptions(presets, faults), [OTHER, 'other …']];
    setOptions(select, options, faults);
    select.title = faults ? `Sensor faults:\n${faults.replaceAll(',', ',\n')}` : 'Sensor faults';
  };
  /** @param {string} faults */
  const apply = (faults) => (choose(faults), show());
  select.addEventListener('change', () => {
    if (select.value !== OTHER) return apply(select.value);
    select.value = selected();
    dialog.open(selected(), { check, choose: apply });
  });
  return (list) => ((presets = list), show());
}

/**
 * Creates the row of a fault in the dialog; its button adds the fault to the text.
 * @param {FaultInfo} fault
 * @param {HTMLInputElement} input
 */
function faultRow({ fault, meaning, parameters }, input) {
  const specific = parameters.slice(0, -2); // without `from` and `to`, which every fault has
  const add = () => {
    const value = parameters[0].default ?? '';
    input.value = [input.value.trim(), `${fault}=${value}`].filter(Boolean).join(',');
    input.dispatchEvent(new Event('input'));
    input.focus();
  };
  const button = createButton('text quiet', fault, add, { title: 'Add this fault' });
  const defaults = specific.map((p) => (p.default === null ? p.name : `${p.name}=${p.default}`));
  const row = document.createElement('tr');
  for (const cell of [button, defaults.join(' '), meaning]) row.insertCell().append(cell);
  row.cells[1].title = specific.map((p) => `${p.name}: ${p.meaning} (${p.unit})`).join('\n');
  return row;
}
