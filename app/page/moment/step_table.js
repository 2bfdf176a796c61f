/** The numbers of a step: a row for each modality alone and one for the fused belief. */

import { swatch, variable } from '../core/palette.js';
import { fixed, percent, spoken } from '../core/units.js';

/**
 * @typedef {{title: string, unit: string, help: string, value: (source: string, step: number) => string, best?: boolean}} Column
 */

export class Numbers {
  #table;
  #trace = null;
  #columns = [];
  #cells = [];

  /** @param {HTMLTableElement} table */
  constructor(table) {
    this.#table = table;
  }

  /** @param {import('../data/trace.js').Trace} trace @param {string} component whose weights are shown where each has its own. */
  show(trace, component) {
    this.#trace = trace;
    this.#columns = columns(trace, trace.components.findIndex((c) => c.name === component));
    const head = this.#columns.map(({ title, unit, help }) => element('th', { scope: 'col', title: help }, title, element('small', {}, unit || ' ')));
    const top = element('tr', {}, element('td', {}), ...head);
    this.#cells = [];
    const rows = trace.sources.map((source) => {
      const line = `--line: var(${variable(source)})`;
      const cells = this.#columns.map((column) => element('td', column.title === 'share' ? { class: 'share' } : {}));
      this.#cells.push(cells);
      const title = element('th', { scope: 'row' }, swatch(source), trace.called(source));
      return element('tr', { class: source, style: line }, title, ...cells);
    });
    this.#table.replaceChildren(element('thead', {}, top), element('tbody', {}, ...rows));
  }

  move(step) {
    if (!this.#trace) return;
    this.#trace.sources.forEach((source, row) =>
      this.#columns.forEach((column, i) => {
        const cell = this.#cells[row][i];
        cell.textContent = column.value(source, step);
        if (column.title === 'share') cell.style.setProperty('--share', String(this.#trace.weight('acting', source, column.component)?.[step] ?? 0));
      }),
    );
  }
}

/** @param {import('../data/trace.js').Trace} trace @returns {Column[]} */
function columns(trace, component) {
  const sure = trace.has('estimate_sigma');
  const list = [
    { title: 'error', unit: 'cm', help: 'Distance to the true position', value: (s, t) => fixed(trace.error(s, 'position')[t], 2) },
    sure && { title: 'σ', unit: 'cm', help: 'Claimed standard deviation of the position: root of the summed variances', value: (s, t) => fixed(trace.radius(s)[t], 2) },
  ];
  for (const angle of trace.angles) {
    const name = spoken(trace.components[angle].name);
    list.push(
      { title: name, unit: 'err. °', help: `Error of the ${name}`, value: (s, t) => fixed(trace.error(s, angle)[t], 1) },
      sure && { title: 'σ', unit: '°', help: `Claimed standard deviation of the ${name}`, value: (s, t) => fixed(trace.sigma(s, angle)[t], 1) },
    );
  }
  const shared = trace.sources.length > 1; // else there is no row for a modality's
  if (shared && trace.has('weights')) {
    const of = trace.weightWidth > 1 ? spoken(trace.components[component].name) : 'raw';
    list.push({ title: 'β', unit: of, help: `Fusion weight as the network gave it${trace.weightWidth > 1 ? `, for ${of}` : ''}`, value: (s, t) => fixed(trace.weight('raw', s, component)?.[t], 2) });
  }
  if (shared && trace.has('acting')) {
    list.push({ title: 'share', unit: 'acting', component, help: 'Share of the modality in the fused belief, as it acted', value: (s, t) => percent(trace.weight('acting', s, component)?.[t]) });
  }
  return list.filter(Boolean);
}

function element(tag, attributes, ...children) {
  const made = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}
