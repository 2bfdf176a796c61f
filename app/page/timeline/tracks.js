/** Which charts the time line has for a trace and a state. */

import { fixed, spoken } from '../core/units.js';

/** What the lowest chart can be about, by the name in an address. */
export const KINDS = {
  error: 'error',
  signed: 'signed error',
  nees: 'NEES',
  innovation: 'innovation',
  particles: 'particles',
};

/**
 * @param {import('../data/trace.js').Trace} trace @param {import('../core/state.js').State} state
 * @param {import('../data/trace.js').Trace | null} other of the same episode, drawn over it
 * @returns {import('./chart.js').Track[]}
 */
export function tracks(trace, state, other = null) {
  const component = trace.components.findIndex((c) => c.name === state.component);
  const makers = [(of) => weights(of, state.weights, component), (of) => estimates(of, component), (of) => LOWEST[state.track](of, component)];
  return makers.map((make) => (other ? over(make(trace), make(other)) : make(trace)));
}

/** The track of the other trace over that of the first: its lines alone. */
function over(track, other) {
  if (other.note) return track;
  const lines = other.series.filter((s) => s.name !== 'truth').map(({ name, values }) => ({ name, values, other: true }));
  if (track.note) return { ...other, series: lines };
  const limits = track.limits && other.limits && [Math.min(track.limits[0], other.limits[0]), Math.max(track.limits[1], other.limits[1])];
  const both = { ...track, limits, series: [...track.series, ...lines] };
  // One filter has weights of a network, the other only shares.
  return kindOf(track) === kindOf(other) ? both : { ...both, title: `${kindOf(track)} / ${kindOf(other).toLowerCase()}`, help: `${track.title}; dashed: ${other.title}` };
}

const kindOf = ({ title }) => title.split(',')[0];

/** @returns {import('./chart.js').Track} or, where nothing is weighed, a line that says so. */
function weights(trace, chosen, component) {
  const both = trace.has('weights') && trace.has('acting');
  const kind = both ? chosen : trace.has('weights') ? 'raw' : 'acting';
  const series = known(trace.modalities, (name) => trace.weight(kind, name, component));
  if (!series.length) return none('Weights', unweighed(trace));
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
  const sources = known(trace.sources, (source) => trace.mean(source, component), (source) => trace.sigma(source, component));
  const truth = { name: 'truth', values: trace.truth(component) };
  return { title: capital(spoken(name)), unit: trace.shown(component).unit, series: [truth, ...sources], digits: 1 };
}

const LOWEST = { error, signed, nees, innovation, particles };

function error(trace, component) {
  const angle = trace.angles.includes(component);
  if (!trace.truth(component).some(Number.isFinite)) return none('Error', UNKNOWN);
  return {
    title: angle ? `${capital(spoken(trace.components[component].name))} error` : 'Position error',
    unit: angle ? '°' : 'cm',
    series: known(trace.sources, (source) => trace.error(source, angle ? component : 'position')),
    fromZero: true,
    digits: 1,
  };
}

/** What estimates are off by, with the band of what they claim: where it leaves zero out, the filter is surprised. */
function signed(trace, component) {
  if (!trace.truth(component).some(Number.isFinite)) return none('Signed error', UNKNOWN);
  const sources = known(trace.sources, (source) => trace.offset(source, component), (source) => trace.sigma(source, component));
  const truth = { name: 'truth', values: new Float32Array(trace.steps) };
  return { title: 'Signed error', unit: trace.shown(component).unit, help: 'Estimate less truth, with what it claims', series: [truth, ...sources], digits: 1 };
}

function nees(trace) {
  const series = known(trace.sources, (source) => trace.nees(source));
  if (!series.length) return none('NEES', trace.has('nees') ? UNKNOWN : 'None: this filter does not say how sure it is.');
  const bounds = trace.header.nees_bounds;
  const [low, high] = [fixed(bounds[0], 2), fixed(bounds[1], 1)];
  return {
    title: 'NEES/n',
    unit: `${low}–${high}`,
    help: `Squared error over the claimed covariance, by component: 1 on average. 95 % of a consistent filter's steps are between ${low} and ${high}; more is over-confident.`,
    series,
    bounds,
    log: true,
  };
}

function innovation(trace, component) {
  const series = known(trace.modalities, (name) => trace.innovation(name, component), (name) => trace.innovationSigma(name, component));
  if (!series.length) return none('Innovation', uninnovative(trace.header.kind));
  const help = 'What each modality measured less what was predicted. 95 % are within the band where both claim what is so.';
  return { title: 'Innovation', unit: trace.shown(component).unit, help, series, digits: 1 };
}

function uninnovative(kind) {
  if (kind === 'pf') return 'None: a particle filter asks how likely each particle is, and measures no state to compare with.';
  if (kind === 'lstm') return 'None: the network compares no measurement with a prediction.';
  return 'None: this filter does not say what it measured and what it expected.';
}

function particles(trace) {
  const values = trace.particles;
  if (!values) return none('Particles', unparticular(trace.header.kind));
  const most = trace.header.settings?.particles ?? values.reduce((a, b) => Math.max(a, b), 0);
  return {
    title: 'Particles',
    unit: `of ${most}`,
    help: 'Effective sample size: how many particles still carry weight',
    series: [{ name: 'fused', values }],
    limits: [0, 1.04 * most],
    digits: 0,
  };
}

function unparticular(kind) {
  if (kind === 'lstm') return 'None: an LSTM has no particles.';
  return kind === 'foreign' ? 'None: this filter shows no particles.' : 'None: a Kalman filter has a Gaussian and no particles.';
}

const UNKNOWN = 'None: the true state of this run is not known.';
const none = (title, note) => ({ title, unit: '', series: [], note });

/** A line for each name whose values are known. @returns {import('./chart.js').Series[]} */
function known(names, valuesOf, sigmaOf = () => undefined) {
  const lines = names.map((name) => ({ name, values: valuesOf(name), sigma: sigmaOf(name) }));
  return lines.filter(({ values }) => values?.some(Number.isFinite));
}

/** (T,) The error that the largest is sought in. */
export function shownError(trace, state) {
  const component = trace.components.findIndex((c) => c.name === state.component);
  return trace.error('fused', trace.angles.includes(component) ? component : 'position');
}

/** A symbol as x stays small. */
const capital = (text) => (text.length > 1 ? text[0].toUpperCase() + text.slice(1) : text);
