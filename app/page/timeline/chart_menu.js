/** The menu that adds, removes, reorders and exports the charts of the timeline, and selects its time axis. */

/** @import { Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */

import { create, createButton, html } from '../core/dom.js';
import { choice } from '../widgets/pickers.js';
import { chartKeys, formatCharts, moved, toggled } from './chart_list.js';
import { bindExport } from './export_charts.js';
import { chartOptions } from './tracks.js';

const MARGIN = 8; // px to the edge of the window

export class ChartMenu {
  #store;
  #rows;
  /** @type {Trace | null} */
  #trace = null;

  /**
   * @param {HTMLElement} menu a popover
   * @param {HTMLElement} button that opens it
   * @param {Store} store
   * @param {() => void} resetSizes
   */
  constructor(menu, button, store, resetSizes) {
    this.#store = store;
    this.#rows = html('.rows', menu);
    menu.addEventListener('beforetoggle', () => {
      const { left, top } = button.getBoundingClientRect();
      menu.style.left = `${left}px`;
      menu.style.bottom = `${window.innerHeight - top + MARGIN / 2}px`;
      menu.style.maxHeight = `${top - MARGIN}px`;
      this.#draw();
    });
    bindExport(menu, store, () => this.#trace);
    html('.reset', menu).addEventListener('click', () => {
      resetSizes();
      this.#set([]);
    });
  }

  /** @param {Trace} trace */
  show(trace) {
    this.#trace = trace;
  }

  /** @param {readonly string[]} keys */
  #set(keys) {
    this.#store.set({ charts: keys.length ? formatCharts(keys) : '' });
    this.#draw();
  }

  #draw() {
    const trace = this.#trace;
    if (!trace) return;
    const axes = { steps: 'steps', seconds: 'seconds' };
    choice(html('#time-axis'), axes, this.#store.state.time, (time) => this.#store.set({ time }));
    const labels = new Map(chartOptions(trace, this.#store.state.track));
    const keys = chartKeys(this.#store.state, [...labels.keys()]);
    const hidden = [...labels.keys()].filter((key) => !keys.includes(key));
    this.#rows.replaceChildren(
      ...[...keys, ...hidden].map((key) => this.#row(key, labels.get(key) ?? key, keys)),
    );
  }

  /**
   * @param {string} key
   * @param {string} label
   * @param {readonly string[]} keys
   */
  #row(key, label, keys) {
    const box = create('input', { type: 'checkbox', checked: keys.includes(key) });
    box.disabled = keys.length === 1 && box.checked;
    box.addEventListener('change', () => {
      this.#set(toggled(keys, key));
      this.#focus(key, 'input');
    });
    const row = create('li', {}, create('label', {}, box, label));
    row.dataset.key = key;
    if (!box.checked) return row;
    const arrows = /** @type {[string, string, number][]} */ ([
      ['↑', 'up', -1],
      ['↓', 'down', 1],
    ]);
    for (const [text, direction, places] of arrows) {
      const move = () => {
        this.#set(moved(keys, key, places));
        this.#focus(key, `.${direction}`);
      };
      const ariaLabel = `Move ${label} ${direction}`;
      const disabled = keys.at(places < 0 ? 0 : -1) === key;
      row.append(createButton(direction, text, move, { ariaLabel, disabled }));
    }
    return row;
  }

  /**
   * Keeps the focus where it was before the rows were replaced.
   * @param {string} key
   * @param {string} control
   */
  #focus(key, control) {
    const row = html(`[data-key="${key}"]`, this.#rows);
    const enabled = row.querySelector(`${control}:enabled`) ?? row.querySelector('button:enabled');
    if (enabled instanceof HTMLElement) enabled.focus();
  }
}
