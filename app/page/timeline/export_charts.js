/** Export of the displayed charts over the visible steps, which the server draws. */

/** @import { State, Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */

import { element, html, messageOf } from '../core/dom.js';
import { download } from '../core/download.js';
import { sentence } from '../core/units.js';
import { timelineFile } from '../data/api.js';
import { chartKeys } from './chart_list.js';
import { SCALAR, chartOptions } from './tracks.js';

/**
 * Connects the buttons of the export.
 * @param {HTMLElement} menu
 * @param {Store} store
 * @param {() => Trace | null} displayed
 */
export function bindExport(menu, store, displayed) {
  const buttons = [...html('.export', menu).querySelectorAll('button')];
  const output = html('output', menu);
  /** @param {string} format */
  const save = async (format) => {
    const trace = displayed();
    if (!trace) return;
    output.textContent = 'Exporting…';
    for (const button of buttons) button.disabled = true;
    try {
      const selection = { ...trace.selection, against: store.state.against };
      const { content, name } = await timelineFile(selection, format, query(trace, store.state));
      download(content, name);
      output.textContent = 'Saved.';
    } catch (error) {
      output.textContent = sentence(`Export failed: ${messageOf(error)}`);
    }
    for (const button of buttons) button.disabled = false;
  };
  for (const button of buttons)
    button.addEventListener('click', () => save(button.textContent.toLowerCase()));
  menu.addEventListener('beforetoggle', () => (output.textContent = ''));
}

/**
 * Returns the charts and how they are displayed, as a query.
 * @param {Trace} trace
 * @param {State} state
 */
function query(trace, state) {
  const available = chartOptions(trace, state.track).map(([key]) => key);
  const charts = chartKeys(state, available)
    .map((key) => (key === 'track' ? state.track : key))
    .filter((key) => !key.startsWith(SCALAR) || trace.has(key)); // else its chart is a note
  const { component, weights, window, time } = state;
  const group = element('#group', HTMLSelectElement).value;
  return [
    ...charts.map((chart) => ['chart', chart]),
    ...Object.entries({ component, weights, window, time, group }),
  ];
}
