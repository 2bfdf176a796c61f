/** The slider for the cross-section that the maps show: the value of the only component that is not on the maps. */

/** @import { Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */

import { element, html } from '../core/dom.js';
import { displayName, fixed, signed, wrapDegrees } from '../core/units.js';
import { mapPlane } from './map_choices.js';

const MARGIN = { angle: 60, part: 0.5 }; // beyond the values of the episode: degrees, or a part of their range

export class AngleSlider {
  #label;
  #input;
  #reset;
  #store;
  /** @type {Trace | null} */
  #trace = null;
  #component = -1; // index in the state

  /**
   * @param {HTMLElement} label with the slider inside
   * @param {HTMLButtonElement} reset button that returns to the true value
   * @param {Store} store
   */
  constructor(label, reset, store) {
    this.#label = label;
    this.#reset = reset;
    this.#store = store;
    this.#input = element('input', HTMLInputElement, label);
    this.#input.addEventListener('input', (event) => {
      if (!this.#trace) return;
      const { scale } = this.#trace.unitOf(this.#component);
      const angle = this.#input.valueAsNumber / scale;
      store.set({ angle }, { inputTime: event.timeStamp });
    });
    reset.addEventListener('click', () => store.set({ angle: null }));
    store.when(['angle'], ({ step }) => this.move(step));
  }

  /** @param {Trace} trace */
  show(trace) {
    this.#trace = trace;
    const { state } = this.#store;
    const plane = mapPlane(state, trace);
    const others = trace.components.filter(({ name }) => !plane.includes(name));
    const fixes = others.length === 1 && state.others !== 'marginal';
    this.#component = fixes ? trace.components.indexOf(others[0]) : -1;
    this.#label.hidden = this.#reset.hidden = this.#component < 0;
    if (this.#component < 0) return;
    const angles = defaultAngles(trace, this.#component).filter(Number.isFinite);
    const [low, high] = angles.reduce(
      ([min, max], v) => [Math.min(min, v), Math.max(max, v)],
      [Infinity, -Infinity],
    );
    const isAngle = trace.angles.includes(this.#component);
    const margin = isAngle ? MARGIN.angle : MARGIN.part * Math.max(high - low, 1);
    this.#input.min = String(Math.floor(low - margin));
    this.#input.max = String(Math.ceil(high + margin));
    this.#input.disabled = false;
    html('#angle-name', this.#label).textContent = displayName(
      trace.components[this.#component].name,
    );
  }

  /** @param {number} step */
  move(step) {
    const trace = this.#trace;
    if (!trace || this.#component < 0) return;
    const reference = defaultAngles(trace, this.#component)[step];
    const isTrue = Number.isFinite(trace.truth(this.#component)[step]);
    const { angle } = this.#store.state;
    const { unit, scale } = trace.unitOf(this.#component);
    const value = angle === null ? reference : angle * scale;
    if (document.activeElement !== this.#input || angle === null) this.#input.value = String(value);
    const difference = value - reference;
    const text = `${fixed(value)}${unit}`;
    const name = isTrue ? 'true' : 'estimated';
    const isAngle = trace.angles.includes(this.#component);
    const offset = `${signed(isAngle ? wrapDegrees(difference) : difference)}${unit}`;
    html('output', this.#label).textContent =
      angle === null ? `${text} ${isTrue ? 'true' : 'est.'}` : text;
    this.#label.title =
      angle === null
        ? `Cross-section of the maps at the ${name} value`
        : `${offset} from the ${name} value`;
    this.#reset.disabled = angle === null;
  }
}

/**
 * Returns the default angles of the cross-section over time: the true ones, or the estimated ones where the truth is unknown.
 * @param {Trace} trace
 * @param {number} component
 */
function defaultAngles(trace, component) {
  const estimate = trace.mean('fused', component);
  return trace.truth(component).map((v, t) => (Number.isFinite(v) ? v : (estimate?.[t] ?? NaN)));
}
