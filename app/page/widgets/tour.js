/** A tour of the page in six steps, each beside the part that it explains. */

import { create, createButton } from '../core/dom.js';

/** @typedef {{part: string, title: string, text: string}} TourStep part: selector */

/** @type {TourStep[]} */
export const STEPS = [
  {
    part: '#finding',
    title: 'Finding',
    text: 'The result of this run in words. The button beside it goes to the step that shows it best.',
  },
  {
    part: '#timeline',
    title: 'Timeline',
    text: 'The weight of each modality, the estimates and their errors over time. Coloured bands are steps in contact; hatched bands are steps without an image. Click or drag to move the cursor.',
  },
  {
    part: '#maps',
    title: 'Likelihood maps',
    text: 'Where each modality, and the fusion of all, locates the object at this step. The cross is the true position.',
  },
  {
    part: '#step',
    title: 'Current step',
    text: 'The camera image as the filter receives it, and the error and standard deviation of each update.',
  },
  {
    part: '#views',
    title: 'Tabs',
    text: 'Diagnosis names the probable cause of a fault; Failures ranks the worst steps; Compare repeats the run with one change; Fine-tune trains selected modules.',
  },
  {
    part: 'header',
    title: 'Selection and faults',
    text: 'Choose the filter and the episode, inject sensor faults, save a Rerun recording. Ctrl K finds every command.',
  },
];

const GAP = 10; // px between the box and its part

/**
 * Returns where a box fits beside a part: below, above, left or right of it, else in the middle of the window.
 * @param {{left: number, top: number, right: number, bottom: number}} part
 * @param {{width: number, height: number}} box
 * @param {{width: number, height: number}} view
 */
export function placeBeside(part, box, view) {
  const x = clamp((part.left + part.right - box.width) / 2, view.width - box.width);
  const y = clamp((part.top + part.bottom - box.height) / 2, view.height - box.height);
  const places = [
    { left: x, top: part.bottom + GAP },
    { left: x, top: part.top - GAP - box.height },
    { left: part.left - GAP - box.width, top: y },
    { left: part.right + GAP, top: y },
  ];
  const fits = places.find(
    ({ left, top }) =>
      left >= 0 && top >= 0 && left + box.width <= view.width && top + box.height <= view.height,
  );
  return fits ?? { left: (view.width - box.width) / 2, top: (view.height - box.height) / 2 };
}

/** @param {number} value @param {number} end */
const clamp = (value, end) => Math.min(Math.max(value, GAP), end - GAP);

export class Tour {
  #title = create('h2', { id: 'tour-title' });
  #text = create('p');
  #count = create('span');
  #back = createButton('text', 'Back', () => this.#show(this.#step - 1));
  #next = createButton('text next', '', () => this.#show(this.#step + 1));
  #box;
  #step = 0;
  /** Has the focus again at the end. @type {HTMLElement | null} */
  #opener = null;

  constructor() {
    const label = { ariaLabel: 'End the tour' };
    const close = createButton('text quiet close', '×', () => this.end(), label);
    const buttons = create('div', { className: 'buttons' }, this.#count, this.#back, this.#next);
    this.#box = create(
      'div',
      { id: 'tour', popover: 'manual', role: 'dialog' },
      close,
      this.#title,
      this.#text,
      buttons,
    );
    this.#box.setAttribute('aria-labelledby', 'tour-title');
    this.#text.ariaLive = 'polite';
    this.#box.addEventListener('keydown', (event) => {
      const direction = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (event.key === 'Escape') this.end();
      else if (direction && STEPS[this.#step + direction]) this.#show(this.#step + direction);
      else return;
      event.preventDefault();
      event.stopPropagation();
    });
    window.addEventListener('resize', () => this.#place());
    document.body.append(this.#box);
  }

  start() {
    this.#opener = document.activeElement instanceof HTMLElement ? document.activeElement : null;
    this.#box.showPopover();
    this.#show(0);
  }

  end() {
    this.#box.hidePopover();
    this.#mark(null);
    this.#opener?.focus();
  }

  /** @param {number} step ends after the last one */
  #show(step) {
    if (step >= STEPS.length) return this.end();
    this.#step = Math.max(step, 0);
    const { title, text } = STEPS[this.#step];
    this.#title.textContent = title;
    this.#text.textContent = text;
    this.#count.textContent = `${this.#step + 1} of ${STEPS.length}`;
    this.#back.disabled = this.#step === 0;
    this.#next.textContent = this.#step === STEPS.length - 1 ? 'Done' : 'Next';
    this.#place();
    this.#next.focus();
  }

  #place() {
    if (!this.#box.matches(':popover-open')) return;
    const part = document.querySelector(STEPS[this.#step].part);
    this.#mark(part);
    if (!part) return;
    const view = { width: window.innerWidth, height: window.innerHeight };
    const place = placeBeside(
      part.getBoundingClientRect(),
      this.#box.getBoundingClientRect(),
      view,
    );
    this.#box.style.left = `${place.left}px`;
    this.#box.style.top = `${place.top}px`;
  }

  /** @param {Element | null} part */
  #mark(part) {
    for (const other of document.querySelectorAll('.toured')) other.classList.remove('toured');
    part?.classList.add('toured');
  }
}
