/** Parts of the page that several panels share: loading states, properties of the trace and the current step. */

/** @import { Trace } from '../data/trace.js' */
/** @import { Curve } from '../types/server.js' */

import { ServerError } from '../data/api.js';
import { errorSourcesText } from '../step/error_sources.js';
import { stepSummary } from '../step/step_summary.js';
import { setPanelState } from '../widgets/panel_state.js';
import { element, html, messageOf } from './dom.js';
import { swatch } from './colours.js';
import { stats } from './measurements.js';
import { sentence } from './units.js';

const LOADING_DELAY = 150; // ms until a panel shows that it loads

/** Bodies of the panels that display the trace; the first one contains the maps. */
const bodies = ['#heatmaps', '#step .body', '#timeline .body'].map((selector) => html(selector));

/** Called when the timeline, and the maps if there are any, are displayed. */
export let markUseful = () => {};
/** Resolves after `markUseful`. */
export const useful = new Promise((resolve) => {
  markUseful = () => requestAnimationFrame(resolve);
}).then(() => (stats.useful = performance.now()));

/**
 * @param {string} text
 * @param {number} [share] 0..1
 */
export function showLoading(text, share) {
  enableExports(false);
  for (const body of bodies) setPanelState(body, 'loading', text, share);
}

/**
 * Shows that a trace is loaded, after a delay, and its progress.
 * @returns {{progress: (share: number) => void, stop: () => void}}
 */
export function startLoading() {
  const timer = setTimeout(() => showLoading('Loading …'), LOADING_DELAY);
  return {
    progress: (share) => {
      clearTimeout(timer);
      showLoading('Running the filter …', share);
    },
    stop: () => clearTimeout(timer),
  };
}

/**
 * Empties all panels that display the trace after an error, which the finding and the scene show.
 * @param {unknown} error
 * @returns {string} its text
 */
export function showError(error) {
  const isReadable = error instanceof ServerError;
  if (!isReadable) console.error(error);
  const text = isReadable ? error.message : `The page failed: ${messageOf(error)}`;
  html('#step-summary').textContent = '';
  [html('#readout b').textContent, html('#readout span').textContent] = ['–', ''];
  showDataWarning(null);
  enableExports(false);
  for (const body of bodies) setPanelState(body, 'empty', 'No run to display');
  return text;
}

/** @param {boolean} hasRun whether there is a run, which can be saved and reported */
function enableExports(hasRun) {
  for (const selector of ['#save', '#report'])
    element(selector, HTMLButtonElement).disabled = !hasRun;
}

/** @param {string | null | undefined} warning how the data differ from the training data */
function showDataWarning(warning) {
  const line = html('#data-warning');
  line.hidden = !warning;
  line.textContent = warning ? sentence(`Warning: ${warning}`) : '';
}

/**
 * Adapts titles, legends and buttons to a trace.
 * @param {Trace} trace
 */
export function showProperties(trace) {
  enableExports(true);
  for (const body of bodies.slice(1)) setPanelState(body, 'ready');
  const { no_maps: noMaps, data_warning: warning } = trace.header;
  showDataWarning(warning);
  html('#maps').classList.toggle('no-effector', !trace.has('readings/effector_position'));
  if (noMaps) setPanelState(html('#heatmaps'), 'empty', noMaps);
  showBlackouts(trace);
  html('#sigma-key').hidden = !trace.has('estimate_sigma');
  element('#largest-error', HTMLButtonElement).disabled = !trace.truth(0).some(Number.isFinite);
  html('#swatches').replaceChildren(
    ...['truth', ...trace.sources].flatMap((name) => [swatch(name), ` ${trace.label(name)}  `]),
  );
}

/**
 * Shows the legend of blackouts if the trace has any.
 * @param {Trace} trace
 */
export function showBlackouts(trace) {
  html('#blackout-key').hidden = !trace.blackout.some(Boolean);
}

/**
 * Shows the number and the time of a step.
 * @param {Trace} trace
 * @param {number} step
 */
export function showCount(trace, step) {
  html('#readout b').textContent = `${step} / ${trace.steps - 1}`;
  html('#readout span').textContent = trace.timeText(step);
}

/**
 * Shows the summary of a step.
 * @param {Trace} trace
 * @param {number} step
 * @param {string} component
 * @param {Curve[]} sources of the error
 */
export function showSummary(trace, step, component, sources) {
  const index = trace.components.findIndex(({ name }) => name === component);
  const { tone, text } = stepSummary(trace, step, index, errorSourcesText(sources, step));
  const line = html('#step-summary');
  line.dataset.tone = tone;
  line.textContent = line.title = text;
}
