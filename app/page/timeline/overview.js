/** The overview above the charts: the whole episode with its events and the window that the charts show. */

/** @import { EventMarks } from './event_marks.js' */
/** @import { Shading } from './chart.js' */
/** @import { StepAxis } from './step_axis.js' */
/** @import { StepWindow } from './step_window.js' */

import { create, context2d } from '../core/dom.js';
import { colour } from '../core/colours.js';
import { GUTTER, hatching } from './chart.js';

/**
 * @typedef {object} Target of the overview
 * @property {() => StepWindow} all steps
 * @property {() => StepAxis} axis
 * @property {() => StepWindow} window
 * @property {(window: StepWindow) => void} setWindow
 * @property {(step: number, timeStamp: number) => void} scrub
 *
 * @typedef {'first' | 'last' | 'window' | 'brush'} Part
 * @typedef {{part: Part, x: number, step: number, window: StepWindow}} Drag
 */

const MIN_DRAG = 4; // px
const LARGE_STEP = 10;

export class Overview {
  #host;
  #target;
  #marks;
  #canvas = create('canvas');
  #cursor = create('i', { className: 'at' });
  #window = create('div', { className: 'window', title: 'Visible steps: drag to move them' });
  /** @type {Record<'first' | 'last', HTMLElement>} */
  #handles = { first: handle('First visible step'), last: handle('Last visible step') };
  /** @type {Drag | null} */
  #drag = null;
  #width = 1; // px of the steps

  /**
   * @param {HTMLElement} host contains the element of the marks
   * @param {EventMarks} marks
   * @param {Target} target
   */
  constructor(host, marks, target) {
    this.#host = host;
    this.#marks = marks;
    this.#target = target;
    this.#window.append(this.#handles.first, this.#handles.last);
    host.prepend(this.#canvas, this.#cursor, this.#window);
    host.addEventListener('pointerdown', (event) => this.#press(event));
    host.addEventListener('pointermove', (event) => this.#move(event));
    host.addEventListener('pointerup', (event) => this.#release(event));
    host.addEventListener('pointercancel', () => (this.#drag = null));
    for (const [part, element] of Object.entries(this.#handles))
      element.addEventListener('keydown', (event) =>
        this.#pressKey(event, /** @type {'first' | 'last'} */ (part)),
      );
  }

  /**
   * Draws the episode.
   * @param {Shading} shading
   * @param {ArrayLike<number>} error of the fused estimate, empty without truth
   */
  draw(shading, error) {
    const { clientWidth, clientHeight } = this.#host;
    this.#width = Math.max(1, clientWidth - GUTTER.left - GUTTER.right);
    const [canvas, ratio] = [this.#canvas, devicePixelRatio];
    [canvas.width, canvas.height] = [this.#width * ratio, clientHeight * ratio];
    canvas.style.width = `${this.#width}px`;
    const ctx = context2d(canvas);
    ctx.scale(ratio, ratio);
    const x = (/** @type {number} */ step) => this.#x(step) - GUTTER.left;
    ctx.fillStyle = colour('contact-band');
    for (const [first, last] of shading.contact)
      ctx.fillRect(x(first - 0.5), 0, x(last + 0.5) - x(first - 0.5), clientHeight);
    ctx.fillStyle = hatching(ctx) ?? 'transparent';
    for (const [first, last] of shading.blackout)
      ctx.fillRect(x(first - 0.5), 0, x(last + 0.5) - x(first - 0.5), clientHeight / 2);
    const highest = Array.from(error).reduce((a, b) => (b > a ? b : a), 0);
    ctx.strokeStyle = colour('fused');
    ctx.beginPath();
    for (let t = 0; t < error.length; t++) {
      const y = (clientHeight - 2) * (1 - error[t] / highest) + 1;
      if (Number.isFinite(y)) ctx.lineTo(x(t), y);
    }
    ctx.stroke();
    this.update();
  }

  /** Shows the window. */
  update() {
    const [[first, last], [from, to]] = [this.#target.all(), this.#target.window()];
    this.#host.classList.toggle('zoomed', to - from < last - first);
    this.#window.style.left = `${this.#x(from)}px`;
    this.#window.style.width = `${Math.max(2, this.#x(to) - this.#x(from))}px`;
    for (const [element, value] of /** @type {const} */ ([
      [this.#handles.first, from],
      [this.#handles.last, to],
    ])) {
      element.ariaValueMin = String(first);
      element.ariaValueMax = String(last);
      element.ariaValueNow = String(Math.round(value));
    }
    this.#marks.place((step) => this.#x(step), this.#width + GUTTER.left);
  }

  /**
   * Moves the cursor.
   * @param {number} step
   */
  move(step) {
    this.#cursor.style.transform = `translateX(${this.#x(step).toFixed(1)}px)`;
  }

  /** @param {number} step */
  #x(step) {
    const axis = this.#target.axis();
    const [first, last] = this.#target.all().map(axis.position);
    return GUTTER.left + ((axis.position(step) - first) / (last - first)) * this.#width;
  }

  /** @param {PointerEvent} event */
  #stepAt({ clientX }) {
    const axis = this.#target.axis();
    const [first, last] = this.#target.all().map(axis.position);
    const share = (clientX - this.#host.getBoundingClientRect().left - GUTTER.left) / this.#width;
    return axis.step(first + Math.min(Math.max(share, 0), 1) * (last - first));
  }

  /** @param {PointerEvent} event */
  #press(event) {
    if (event.button !== 0) return;
    event.stopPropagation(); // no scrubbing of the charts
    const { target, clientX } = event;
    const isZoomed = this.#host.classList.contains('zoomed');
    /** @type {Part} */
    let part = isZoomed && target === this.#window ? 'window' : 'brush';
    if (target === this.#handles.first) part = 'first';
    if (target === this.#handles.last) part = 'last';
    const window = this.#target.window();
    this.#drag = { part, x: clientX, step: this.#stepAt(event), window };
    this.#host.setPointerCapture(event.pointerId);
  }

  /** @param {PointerEvent} event */
  #move(event) {
    const drag = this.#drag;
    if (!drag) return;
    event.stopPropagation();
    if (Math.abs(event.clientX - drag.x) < MIN_DRAG) return;
    this.#target.setWindow(draggedWindow(drag, this.#stepAt(event)));
  }

  /** @param {PointerEvent} event */
  #release(event) {
    const drag = this.#drag;
    this.#drag = null;
    if (!drag || Math.abs(event.clientX - drag.x) >= MIN_DRAG) return;
    if (drag.part === 'brush' || drag.part === 'window')
      this.#target.scrub(drag.step, event.timeStamp);
  }

  /**
   * @param {KeyboardEvent} event
   * @param {'first' | 'last'} part
   */
  #pressKey(event, part) {
    const [from, to] = this.#target.window();
    const step = part === 'first' ? from : to;
    const change = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    const [first, last] = this.#target.all();
    const end = { Home: first, End: last }[event.key];
    if (change === undefined && end === undefined) return;
    event.preventDefault();
    event.stopPropagation();
    const target = end ?? step + (change ?? 0) * (event.shiftKey ? LARGE_STEP : 1);
    this.#target.setWindow(
      draggedWindow(
        { part, x: 0, step, window: [from, to] },
        Math.min(Math.max(target, first), last),
      ),
    );
  }
}

/**
 * Returns the window after one of its parts was dragged to a step.
 * @param {Drag} drag
 * @param {number} step
 * @returns {StepWindow}
 */
export function draggedWindow({ part, step: start, window: [from, to] }, step) {
  if (part === 'window') return [from + step - start, to + step - start];
  const [fixed, moved] = part === 'brush' ? [start, step] : [part === 'first' ? to : from, step];
  return fixed < moved ? [fixed, moved] : [moved, fixed];
}

/** @param {string} ariaLabel */
const handle = (ariaLabel) =>
  create('div', { className: 'handle', role: 'slider', tabIndex: 0, ariaLabel, title: ariaLabel });
