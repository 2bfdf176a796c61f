/** Which charts the time line has for a trace and a state. */

import { spoken } from './units.js';

/**
 * @param {import('./trace.js').Trace} trace @param {import('./state.js').State} state
 * @returns {import('./chart.js').Track[]}
 */
export function tracks(trace, state) {
  const component = trace.components.findIndex((c) => c.name === state.component);
  return [weights(trace, state.weights, component), estimates(trace, component), lowest(trace, state.track, component)];
}

/** @returns {import('./chart.js').Track} or, where nothing is weighed, a line that says so. */
function weights(trace, chosen, component) {
  const both = trace.has('weights') && trace.has('acting');
  const kind = both ? chosen : trace.has('weights') ? 'raw' : 'acting';
  const series = trace.modalities
    .map((name) => ({ name, values: trace.weight(kind, name, component) }))
    .filter((s) => s.values);
  if (!series.length) return { title: 'Weights', unit: '', series, note: unweighed(trace) };
  const what = trace.weightWidth > 1 ? `, ${spoken(trace.components[component].name)}` : '';
  const title = kind === 'raw' ? `Weight β${what}` : `Acting share${what}`;
  const most = Math.max(1, ...series.map((s) => s.values.reduce((a, b) => Math.max(a, b), 0)));
  return { title, unit: '', series, limits: [-0.04 * most, 1.06 * most], digits: 2 };
}

function unweighed({ modalities: [model], fuses, header }) {
  if (fuses) return 'None: this filter does not say how it weighs its modalities.';
  if (model) return `None: ${model.replaceAll('+', ' and ')} ${model.includes('+') ? 'go into one measurement model, which' : 'alone'} decides.`;
  if (header.kind === 'foreign') return 'None: this filter does not say which of its senses it follows.';
  return 'None: the network takes all senses in at once and does not say which it follows.';
}

function estimates(trace, component) {
  const { name } = trace.components[component];
  const { unit } = trace.shown(component);
  const sources = trace.sources.map((source) => ({
    name: source,
    values: trace.mean(source, component),
    sigma: trace.sigma(source, component),
  }));
  const truth = { name: 'truth', values: trace.truth(component) };
  return { title: capital(spoken(name)), unit, series: [truth, ...sources], digits: 1 };
}

function lowest(trace, kind, component) {
  if (kind === 'particles' && trace.particles) {
    const most = trace.header.settings?.particles ?? trace.particles.reduce((a, b) => Math.max(a, b), 0);
    const series = [{ name: 'fused', values: trace.particles }];
    return { title: 'Particles', unit: `of ${most}`, series, limits: [0, 1.04 * most], digits: 0 };
  }
  const angle = trace.angles.includes(component);
  const what = angle ? component : 'position';
  const series = trace.sources.map((name) => ({ name, values: trace.error(name, what) }));
  return {
    title: angle ? `${capital(spoken(trace.components[component].name))} error` : 'Position error',
    unit: angle ? '°' : 'cm',
    series,
    fromZero: true,
    digits: 1,
  };
}

/** (T,) The error that the lowest chart is about. */
export function shownError(trace, state) {
  const component = trace.components.findIndex((c) => c.name === state.component);
  return trace.error('fused', trace.angles.includes(component) ? component : 'position');
}

const capital = (text) => text[0].toUpperCase() + text.slice(1);
