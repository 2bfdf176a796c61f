/** The table of the current step: a row for each modality's update, the fused estimate and each measured channel. */

/** @import { Channel } from '../data/channels.js' */
/** @import { Trace } from '../data/trace.js' */

import { create } from '../core/dom.js';
import { cssVariable, swatch } from '../core/colours.js';
import { displayName, fixed, percent, significant } from '../core/units.js';
import { INNOVATION } from '../data/channels.js';
import { measuredChannels } from '../timeline/channel_tracks.js';

const ROWS = 5; // for which there is room; more are scrolled

/**
 * @typedef {object} Column
 * @property {string} title
 * @property {string} unit
 * @property {string} help
 * @property {(source: string, step: number) => string} text
 * @property {(source: string, step: number) => number} [share] of the cell that is filled, 0..1
 */

export class StepTable {
  #table;
  /** @type {Trace | null} */
  #trace = null;
  /** @type {Column[]} */
  #columns = [];
  /** @type {HTMLElement[][]} */
  #cells = [];
  /** @type {{channel: Channel, cells: HTMLElement[]}[]} */
  #measured = [];

  /** @param {HTMLElement} table */
  constructor(table) {
    this.#table = table;
  }

  /**
   * @param {Trace} trace
   * @param {string} component whose weights are displayed if each component has its own, and of several angles its error
   */
  show(trace, component) {
    this.#trace = trace;
    const index = trace.components.findIndex((c) => c.name === component);
    this.#columns = [...errorColumns(trace, index), ...weightColumns(trace, index)];
    const heads = this.#columns.map(({ title, unit, help }) =>
      create(
        'th',
        { scope: 'col', title: help },
        title,
        create('small', { textContent: unit || ' ' }),
      ),
    );
    this.#cells = trace.sources.map(() =>
      this.#columns.map(({ share }) => create('td', { className: share ? 'share' : '' })),
    );
    const rows = trace.sources.map((source, i) => {
      const label = trace.label(source);
      const title = create('th', { scope: 'row', title: label }, swatch(source), label);
      const row = create('tr', { className: source }, title, ...this.#cells[i]);
      row.style.setProperty('--line', `var(${cssVariable(source)})`);
      return row;
    });
    const columns = trace.channels.columns(INNOVATION);
    const channels = columns.flatMap((column) => measuredChannels(trace, column));
    this.#measured = channels.map((channel) => ({
      channel,
      cells: MEASURED.map(() => create('td')),
    }));
    if (channels.length) rows.push(measuredHeads(), ...this.#measured.map(measuredRow));
    if (rows.length > ROWS)
      this.#table.tabIndex = 0; // so that the keyboard scrolls it
    else this.#table.removeAttribute('tabindex');
    this.#table.replaceChildren(
      create('thead', {}, create('tr', {}, create('td'), ...heads)),
      create('tbody', {}, ...rows),
    );
  }

  /** @param {number} step */
  move(step) {
    this.#trace?.sources.forEach((source, row) =>
      this.#columns.forEach(({ text, share }, i) => {
        const cell = this.#cells[row][i];
        cell.textContent = text(source, step);
        if (share) cell.style.setProperty('--share', String(share(source, step)));
      }),
    );
    for (const { channel, cells } of this.#measured)
      MEASURED.forEach(({ text }, i) => (cells[i].textContent = text(channel, step)));
  }
}

/**
 * Columns of the rows of measured channels, empty at a step without a measurement.
 * @type {{title: string, help: string, text: (channel: Channel, step: number) => string}[]}
 */
const MEASURED = [
  {
    title: 'innov.',
    help: 'Innovation: measurement minus predicted measurement',
    text: ({ values }, t) => significant(values[t]),
  },
  {
    title: 'σ',
    help: 'Predicted standard deviation of the innovation',
    text: ({ values, sigma }, t) => significant(Number.isFinite(values[t]) ? sigma?.[t] : NaN),
  },
  {
    title: 'ratio',
    help: 'Innovation in predicted standard deviations: for a consistent filter within ±2 at 95 % of the steps',
    text: ({ values, sigma }, t) => fixed(values[t] / (sigma?.[t] ?? NaN), 1),
  },
];

/** Returns the row with the titles of the columns of measured channels. */
const measuredHeads = () =>
  create(
    'tr',
    { className: 'measured heads' },
    create('th', { scope: 'row' }, 'measurement'),
    ...MEASURED.map(({ title, help }) => create('th', { scope: 'col', title: help }, title)),
  );

/** @param {{channel: Channel, cells: HTMLElement[]}} row */
function measuredRow({ channel: { name, unit }, cells }) {
  const label = displayName(unit ? `${name} (${unit})` : name);
  const title = create('th', { scope: 'row', title: label }, label);
  return create('tr', { className: 'measured' }, title, ...cells);
}

/**
 * Returns the columns of the main error and of one angle, for which there is room.
 * @param {Trace} trace
 * @param {number} component selected one, of several angles
 * @returns {Column[]}
 */
function errorColumns(trace, component) {
  const { task, mainUnit: unit } = trace;
  const [{ name }, several] = [task.main, task.main.indices.length > 1];
  /** @type {Column[]} */
  const columns = [
    {
      title: 'error',
      unit,
      help: `Error of the ${name}`,
      text: (source, t) => fixed(trace.error(source, 'main')?.[t], 2),
    },
    {
      title: 'σ',
      unit,
      help: `Predicted standard deviation of the ${name}${several ? ': root of the summed variances' : ''}`,
      text: (source, t) => fixed(trace.mainSigma(source)?.[t], 2),
    },
  ];
  const angles = trace.angles.filter((i) => several || i !== task.main.indices[0]);
  for (const angle of angles.includes(component) ? [component] : angles.slice(0, 1)) {
    const angleName = displayName(trace.components[angle].name);
    columns.push(
      {
        title: angleName,
        unit: 'err. °',
        help: `Error of the ${angleName}`,
        text: (source, t) => fixed(trace.error(source, angle)?.[t], 1),
      },
      {
        title: 'σ',
        unit: '°',
        help: `Predicted standard deviation of the ${angleName}`,
        text: (source, t) => fixed(trace.sigma(source, angle)?.[t], 1),
      },
    );
  }
  return columns.filter(({ title }) => title !== 'σ' || trace.has('estimate_sigma'));
}

/**
 * @param {Trace} trace
 * @param {number} component
 * @returns {Column[]} none if the table has no rows for modalities
 */
function weightColumns(trace, component) {
  /** @type {Column[]} */
  const columns = [];
  if (trace.sources.length < 2) return columns;
  const name = displayName(trace.components[component].name);
  if (trace.has('weights'))
    columns.push({
      title: 'β',
      unit: trace.weightWidth > 1 ? name : '',
      help: `Fusion weight, the output of the network${trace.weightWidth > 1 ? `, for ${name}` : ''}`,
      text: (source, t) => fixed(trace.weight('raw', source, component)?.[t], 2),
    });
  if (trace.has('effective_weights')) {
    /** @param {string} source @param {number} t */
    const weight = (source, t) => trace.weight('effective', source, component)?.[t];
    columns.push({
      title: 'weight',
      unit: 'effective',
      help: 'Effective weight: share of the modality in the posterior',
      text: (source, t) => percent(weight(source, t)),
      share: (source, t) => weight(source, t) ?? 0,
    });
  }
  return columns;
}
