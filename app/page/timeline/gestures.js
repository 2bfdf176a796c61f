/** Mouse, touch and wheel on the timeline: scrubbing, panning and zooming. */

/** @import { StepWindow } from './step_window.js' */

import { pageScrolls } from '../core/dom.js';

/**
 * @typedef {object} Target of gestures
 * @property {() => boolean} isReady
 * @property {() => void} measure updates the position of the charts in the browser window
 * @property {(clientX: number) => number} stepAt with a fraction
 * @property {() => number} stepsPerPixel
 * @property {() => StepWindow} window
 * @property {(window: StepWindow) => void} setWindow
 * @property {(step: number, timeStamp: number) => void} scrub
 * @property {(step: number, factor: number) => void} zoom
 * @property {() => void} reset shows the whole episode
 * @property {(event: PointerEvent | null) => void} hover
 * @property {(selection: StepWindow | null) => void} select displays a selection of steps
 *
 * @typedef {'scrub' | 'pan' | 'zoom' | 'pinch'} Kind
 * @typedef {{kind: Kind, x: number, step: number, window: StepWindow}} Drag
 * @typedef {{clientX: number, step: number}} Finger
 */

const MIN_DRAG = 4; // px
const MIDDLE_BUTTON = 1;

/** @param {StepWindow} window @param {number} shift @returns {StepWindow} */
const shifted = ([from, to], shift) => [from + shift, to + shift];

/** @param {number} a @param {number} b @returns {StepWindow} */
const sorted = (a, b) => (a < b ? [a, b] : [b, a]);

export class Gestures {
  #target;
  /** @type {Drag | null} */
  #drag = null;
  /** @type {Map<number, Finger>} */
  #fingers = new Map();

  /**
   * @param {HTMLElement} element
   * @param {Target} target
   */
  constructor(element, target) {
    this.#target = target;
    element.addEventListener('pointerenter', () => target.measure());
    element.addEventListener('pointerdown', (event) => {
      if (!target.isReady() || event.button > MIDDLE_BUTTON) return;
      this.#press(event);
      element.setPointerCapture(event.pointerId);
      target.hover(null);
      this.#move(event);
    });
    element.addEventListener('mousedown', (event) => {
      if (event.button === MIDDLE_BUTTON) event.preventDefault(); // the browser's scrolling
    });
    element.addEventListener('pointermove', (event) => {
      if (!target.isReady()) return;
      if (this.#drag) this.#move(event);
      else target.hover(event);
    });
    element.addEventListener('pointerup', (event) => this.#release(event));
    element.addEventListener('pointercancel', () => {
      this.#fingers.clear();
      this.#release(null);
    });
    element.addEventListener('pointerleave', () => target.hover(null));
    element.addEventListener('dblclick', () => target.reset());
    element.addEventListener('wheel', (event) => this.#turnWheel(event), { passive: false });
  }

  /** @param {PointerEvent} event */
  #press({ button, shiftKey, pointerType, pointerId, clientX }) {
    const step = this.#target.stepAt(clientX);
    /** @type {Kind} */
    const kind = button === MIDDLE_BUTTON ? 'pan' : shiftKey ? 'zoom' : 'scrub';
    this.#drag = { kind, x: clientX, step, window: this.#target.window() };
    if (pointerType === 'touch') this.#fingers.set(pointerId, { clientX, step });
    if (this.#fingers.size !== 2) return;
    this.#drag.kind = 'pinch';
    for (const finger of this.#fingers.values()) finger.step = this.#target.stepAt(finger.clientX);
  }

  /** @param {PointerEvent} event */
  #move(event) {
    const [drag, target] = [this.#drag, this.#target];
    if (!drag) return;
    const { clientX, timeStamp, pointerId } = event;
    const finger = this.#fingers.get(pointerId);
    if (finger) finger.clientX = clientX;
    if (drag.kind === 'pinch') this.#pinch();
    if (drag.kind === 'scrub') target.scrub(target.stepAt(clientX), timeStamp);
    if (drag.kind === 'pan')
      target.setWindow(shifted(drag.window, (drag.x - clientX) * target.stepsPerPixel()));
    if (drag.kind === 'zoom') target.select(sorted(drag.step, target.stepAt(clientX)));
  }

  /** Zooms so that each of two fingers keeps its step. */
  #pinch() {
    const [left, right] = [...this.#fingers.values()].sort((a, b) => a.step - b.step);
    if (!right || right.clientX - left.clientX < MIN_DRAG) return;
    const scale = (right.step - left.step) / (right.clientX - left.clientX); // steps per px
    const [from, to] = this.#target.window();
    const visible = (to - from) / this.#target.stepsPerPixel(); // px
    const offset = (this.#target.stepAt(left.clientX) - from) / this.#target.stepsPerPixel();
    const start = left.step - scale * offset;
    this.#target.setWindow([start, start + scale * visible]);
  }

  /** @param {PointerEvent | null} event null if the gesture was cancelled */
  #release(event) {
    if (event) this.#fingers.delete(event.pointerId);
    const drag = this.#drag;
    this.#drag = null;
    this.#target.select(null);
    if (!event || drag?.kind !== 'zoom' || Math.abs(event.clientX - drag.x) < MIN_DRAG) return;
    this.#target.setWindow(sorted(drag.step, this.#target.stepAt(event.clientX)));
  }

  /** @param {WheelEvent} event */
  #turnWheel(event) {
    if (!this.#target.isReady() || pageScrolls()) return;
    event.preventDefault();
    const { deltaX, deltaY, shiftKey, clientX } = event;
    const horizontal = shiftKey && !deltaX ? deltaY : deltaX;
    if (Math.abs(horizontal) > Math.abs(shiftKey ? 0 : deltaY)) {
      const [from, to] = this.#target.window();
      this.#target.setWindow(shifted([from, to], ((to - from) * horizontal) / 1000));
    } else {
      this.#target.zoom(this.#target.stepAt(clientX), Math.exp(deltaY / 500));
    }
  }
}
