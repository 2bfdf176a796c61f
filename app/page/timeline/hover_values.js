/** All values of the step below the pointer in one table beside it: a row for each source, a column for each chart. */

/** @import { Trace } from '../data/trace.js' */
/** @import { Track } from './chart.js' */

import { create } from '../core/dom.js';
import { colourOf, formatValue } from './legend.js';

const DISTANCE = 14; // px from the pointer

export class HoverValues {
  #host = create('div', { className: 'hover-values', hidden: true, ariaHidden: 'true' });
  #title = create('p');
  #table = create('table');
  /** @type {{text: Text, track: Track, index: number}[]} */
  #cells = [];

  /** @param {HTMLElement} parent */
  constructor(parent) {
    this.#host.append(this.#title, this.#table);
    parent.append(this.#host);
  }

  /**
   * Prepares the table.
   * @param {Track[]} tracks
   */
  show(tracks) {
    this.#cells = [];
    this.hide();
    /** @param {string} name */
    const rank = (name) => [...all].indexOf(name.replace(COMPARED, ''));
    const charts = tracks.filter(({ series }) => series.length);
    const everySeries = charts.flatMap(({ series }) => series);
    const all = new Set(everySeries.map(rowName));
    const names = [...all].sort((a, b) => rank(a) - rank(b)); // the comparison run follows each source
    const titles = charts.map(({ title, unit }) => (unit ? `${title} (${unit})` : title));
    const head = create('tr', {}, ...['', ...titles].map((text) => create('th', {}, text)));
    const rows = names.map((name) => {
      const swatch = create('i');
      const first = everySeries.find((series) => rowName(series) === name);
      if (first) swatch.style.background = `var(${colourOf(first)})`;
      const cells = charts.map((track) => {
        const index = track.series.findIndex((series) => rowName(series) === name);
        const text = new Text();
        if (index >= 0) this.#cells.push({ text, track, index });
        return create('td', {}, text);
      });
      return create('tr', {}, create('th', {}, swatch, name), ...cells);
    });
    this.#table.replaceChildren(create('thead', {}, head), create('tbody', {}, ...rows));
  }

  /**
   * Shows the values at a step.
   * @param {Trace} trace
   * @param {number} step
   * @param {{x: number, y: number, width: number, height: number}} pointer px in the charts, and their size
   */
  move(trace, step, { x, y, width, height }) {
    const groups = trace.groups.filter((name) => trace.group(name)[step]);
    const states = [...groups];
    if (trace.blackout[step]) states.push('image blackout');
    if (trace.faulty[step]) states.push(trace.faultLabel);
    const time = `step ${step} · ${trace.timeText(step)}`;
    this.#title.textContent = [time, ...states].join(' · ');
    for (const { text, track, index } of this.#cells)
      text.data = formatValue(track.series[index].values[step], track);
    this.#host.hidden = false;
    const { offsetWidth, offsetHeight } = this.#host;
    const left = x + DISTANCE + offsetWidth > width ? x - DISTANCE - offsetWidth : x + DISTANCE;
    const top = Math.min(Math.max(0, y - offsetHeight / 2), Math.max(0, height - offsetHeight));
    this.#host.style.transform = `translate(${left.toFixed(0)}px, ${top.toFixed(0)}px)`;
  }

  hide() {
    this.#host.hidden = true;
  }
}

const COMPARED = ' (comparison)';

/** @param {import('./chart.js').Series} series */
const rowName = ({ name, comparison }) =>
  comparison && !name.endsWith('standalone') ? `${name}${COMPARED}` : name;
