/** Dialog with the options of a report of the current run; Enter accepts the defaults. */

/** @import { ReportOptions } from '../data/api.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { Selection } from '../types/server.js' */

import { create, createButton, element, html, messageOf } from '../core/dom.js';

const STEP = /^\d+$/;
const BODY = `
  <form aria-label="Report" novalidate>
    <h2>Report of this run</h2>
    <p class="about">A page that opens offline, with its figures, tables and data files.</p>
    <fieldset>
      <legend>Steps shown with scene, image, maps and values</legend>
      <label><input type="radio" name="which" value="worst" checked> the three with the largest position error</label>
      <label><input type="radio" name="which" value="these"> these steps <input type="text" name="steps" aria-label="Steps" placeholder="12, 40" autocomplete="off"></label>
      <p class="offered"></p>
    </fieldset>
    <label><input type="checkbox" name="every"> <span>Include slow diagnostics, such as likelihood maps, saliency and Shapley values</span></label>
    <label><input type="checkbox" name="pdf"> <span>Also write a PDF</span></label>
    <label class="title">Title <input type="text" name="title" maxlength="200" autocomplete="off"></label>
    <p class="error" role="alert"></p>
    <button class="text make" autofocus>Create report</button>
  </form>`;

/** @typedef {{step: number, pinned: {maps: {step: number}, selection: Selection} | null}} StepOffer */

export class ReportDialog {
  #dialog = create('div', { id: 'report-sheet', popover: 'auto', innerHTML: BODY });
  #form;
  #which;
  #steps;
  #title;
  #create;
  /** @type {Trace | null} */
  #trace = null;

  /**
   * @param {HTMLButtonElement} button opens the dialog
   * @param {() => StepOffer} stepOffer returns the current step and the pinned step
   * @param {(trace: Trace, options: ReportOptions) => Promise<void>} createReport throws the reason if it fails
   */
  constructor(button, stepOffer, createReport) {
    this.#create = createReport;
    this.#form = element('form', HTMLFormElement, this.#dialog);
    this.#which = [...this.#form.querySelectorAll('input')].filter(({ name }) => name === 'which');
    this.#steps = this.#input('steps');
    this.#title = this.#input('title');
    this.#dialog.setAttribute('role', 'dialog');
    this.#dialog.setAttribute('aria-label', 'Report of this run');
    button.after(this.#dialog);
    button.popoverTargetElement = this.#dialog;
    button.setAttribute('aria-haspopup', 'dialog');
    this.#steps.addEventListener('input', () =>
      this.#select(this.#steps.value.trim() ? 'these' : 'worst'),
    );
    // After a choice with the mouse, Enter creates the report as well.
    this.#form.addEventListener('change', ({ target }) => {
      if (target instanceof Element && !target.matches(':focus-visible'))
        html('.make', this.#form).focus();
    });
    this.#form.addEventListener('submit', (event) => (event.preventDefault(), this.#submit()));
    this.#dialog.addEventListener('beforetoggle', (event) => {
      if (event.newState !== 'open') return;
      const { bottom, right } = button.getBoundingClientRect();
      this.#dialog.style.top = `${bottom + 5}px`;
      this.#dialog.style.right = `${Math.max(6, innerWidth - right - 60)}px`;
      this.#setError('');
      this.#offer(stepOffer());
    });
  }

  /** @param {string} name */
  #input(name) {
    return element(`input[name=${name}]`, HTMLInputElement, this.#form);
  }

  /** @param {'worst' | 'these'} value */
  #select(value) {
    for (const input of this.#which) input.checked = input.value === value;
  }

  /**
   * Sets the run; the steps of the previous run are cleared.
   * @param {Trace} trace
   */
  show(trace) {
    this.#trace = trace;
    this.#steps.value = '';
    this.#select('worst');
    this.#title.placeholder = `${trace.header.filter} on ${trace.selection.task}`;
  }

  /**
   * Shows buttons that add the current step and the pinned step.
   * @param {StepOffer} offer
   */
  #offer({ step, pinned }) {
    const selection = Object.entries(this.#trace?.selection ?? {});
    const isPinned =
      pinned &&
      pinned.maps.step !== step &&
      selection.every(([key, value]) => Object(pinned.selection)[key] === value);
    /** @type {[string, number][]} */
    const steps = [[`current step ${step}`, step]];
    if (isPinned) steps.push([`pinned step ${pinned.maps.step}`, pinned.maps.step]);
    const buttons = steps.map(([text, value]) =>
      createButton('text quiet', text, () => this.#add(value)),
    );
    html('.offered', this.#form).replaceChildren('Add ', ...buttons);
  }

  /** @param {number} step */
  #add(step) {
    const steps = split(this.#steps.value);
    if (!steps.includes(String(step))) this.#steps.value = [...steps, step].join(', ');
    this.#select('these');
  }

  async #submit() {
    const listed = this.#which.some(({ checked, value }) => checked && value === 'these');
    const steps = listed ? split(this.#steps.value) : [];
    if (!this.#trace) return this.#setError('The run is still loading.');
    const last = this.#trace.steps - 1;
    const invalid = steps.find((step) => !STEP.test(step) || Number(step) > last);
    if (invalid !== undefined)
      return this.#setError(`Step ${invalid} does not exist. The steps are 0 to ${last}.`);
    if (listed && !steps.length)
      return this.#setError('Enter one or more steps, for example 12, 40.');
    try {
      await this.#create(this.#trace, {
        events: steps.map(Number),
        slow: this.#input('every').checked,
        pdf: this.#input('pdf').checked,
        title: this.#title.value.trim(),
      });
      this.#dialog.hidePopover();
    } catch (error) {
      this.#setError(messageOf(error));
    }
  }

  /** @param {string} message */
  #setError(message) {
    html('.error', this.#form).textContent = message;
  }
}

/**
 * Splits a text at commas and spaces.
 * @param {string} text
 */
const split = (text) => text.split(/[\s,]+/).filter(Boolean);
