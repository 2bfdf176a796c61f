/** The charts of the timeline for a trace and a state. */

/** @import { State } from '../core/state.js' */
/** @import { Series as Values } from '../data/arrays.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { Series, Track } from './chart.js' */

import { displayName, fixed } from '../core/units.js';
import { channelOptions, channelTrack, innovationsTrack, isOfChannels } from './channel_tracks.js';
import { FIXED_CHARTS, chartKeys } from './chart_list.js';
import { digitsOf } from './digits.js';
import { areShares } from './stacked_weights.js';

/** Options for the lowest chart: labels and charts. @type {Record<string, [label: string, (trace: Trace, component: number) => Track]>} */
export const TRACKS = {
  error: ['error', errorTrack],
  signed: ['signed error', signedErrorTrack],
  nees: ['NEES/n', neesTrack],
  innovation: ['innovation', innovationTrack],
  particles: ['particles', particleTrack],
};

/** Start of the keys of an external filter's own scalars. */
export const SCALAR = 'extra/';
const ABSENT = 'None: this run does not have it.';
const NO_TRUTH = 'None: the true state of this run is unknown.';

/**
 * @param {Trace} trace
 * @param {Pick<State, 'component' | 'weights' | 'track' | 'charts'>} state
 * @param {Trace | null} [comparison] drawn over the trace
 * @returns {Track[]} from top to bottom
 */
export function tracks(trace, state, comparison = null) {
  const component = trace.components.findIndex((c) => c.name === state.component);
  return shownCharts(trace, state).map((key) => {
    /** @param {Trace} run */
    const build = (run) => ({ ...chartOf(key, run, state, component), key });
    return comparison
      ? overlay(build(trace), build(comparison), comparison.standalone)
      : build(trace);
  });
}

/**
 * @param {string} key
 * @param {Trace} run
 * @param {Pick<State, 'weights' | 'track'>} state
 * @param {number} component
 * @returns {Track}
 */
function chartOf(key, run, { weights, track }, component) {
  if (key === 'weights') return weightTrack(run, weights, component);
  if (key === 'estimate') return estimateTrack(run, component);
  const quantity = key === 'track' ? track : key;
  if (isOfChannels(quantity)) return channelTrack(run, quantity) ?? emptyTrack(quantity, ABSENT);
  const build = TRACKS[quantity]?.[1] ?? scalarTrack(quantity);
  return build(run, component);
}

/**
 * Returns the keys of the displayed charts.
 * @param {Trace} trace
 * @param {Pick<State, 'track' | 'charts'>} state
 */
const shownCharts = (trace, state) =>
  chartKeys(
    state,
    chartOptions(trace, state.track).map(([key]) => key),
  );

/**
 * Returns the charts that the timeline can show: the fixed ones, those of each quantity that is not selected, and those
 * of the channels of sensors.
 * @param {Trace} trace
 * @param {string} selected quantity of the lowest chart
 * @returns {[key: string, label: string][]}
 */
export const chartOptions = (trace, selected) => [
  ...Object.entries(FIXED_CHARTS),
  ...trackOptions(trace, selected).filter(([key]) => key !== selected),
  ...channelOptions(trace),
];

/**
 * Returns the options for the lowest chart: those of every trace, and the filter's own scalars.
 * @param {Trace} trace
 * @param {string} selected is an option in any case
 * @returns {[key: string, label: string][]}
 */
export function trackOptions(trace, selected) {
  const keys = selected in TRACKS ? trace.scalars : [...new Set([...trace.scalars, selected])];
  return [...Object.keys(TRACKS), ...keys].map((key) => [key, TRACKS[key]?.[0] ?? scalarName(key)]);
}

/** @param {string} key */
const scalarName = (key) => displayName(key.slice(SCALAR.length));

/**
 * @param {string} key
 * @returns {(trace: Trace) => Track}
 */
function scalarTrack(key) {
  return (trace) => {
    const [title, values] = [scalarName(key), trace.scalar(key)];
    if (!values) return emptyTrack(title, 'None: this filter does not report it.');
    const help = `${title}, reported by the filter`;
    return { title, unit: '', help, series: [{ name: 'fused', values }], digits: 2 };
  };
}

/**
 * Adds the lines of the comparison run to a track.
 * @param {Track} track
 * @param {Track} other
 * @param {string} [standalone] the only modality of the comparison run
 * @returns {Track}
 */
function overlay(track, other, standalone) {
  if (other.note) return track;
  const lines = other.series
    .filter(({ name }) => name !== 'truth')
    .map(({ name, values, stacked, line }) => ({
      name: name === 'fused' && standalone ? `${displayName(standalone)} standalone` : name,
      values,
      stacked,
      line,
      comparison: true,
    }));
  if (track.note) {
    const areas = lines.some(({ stacked }) => stacked); // edges alone would leave the chart empty
    const title = `${other.title}, comparison`;
    return { ...other, title, series: areas ? other.series : lines };
  }
  /** @type {[number, number] | undefined} */
  const limits = track.limits &&
    other.limits && [
      Math.min(track.limits[0], other.limits[0]),
      Math.max(track.limits[1], other.limits[1]),
    ];
  const merged = { ...track, limits, series: [...track.series, ...lines] };
  // One filter may have fusion weights and the other one only effective weights.
  const [kind, otherKind] = [kindOf(track), kindOf(other)];
  if (kind === otherKind) return merged;
  return {
    ...merged,
    title: `${kind} / ${otherKind.toLowerCase()}`,
    help: `${track.title}; thin lines: ${other.title}`,
  };
}

/** @param {Track} track */
const kindOf = ({ title }) => title.split(',')[0];

/**
 * @param {Trace} trace
 * @param {string} selected `raw` or `effective`
 * @param {number} component
 * @returns {Track}
 */
function weightTrack(trace, selected, component) {
  const both = trace.has('weights') && trace.has('effective_weights');
  const kind = both ? selected : trace.has('weights') ? 'raw' : 'effective';
  const series = availableSeries(trace.modalities, (name) => trace.weight(kind, name, component));
  if (!series.length) return emptyTrack('Weights', missingWeights(trace));
  const scope = trace.weightWidth > 1 ? `, ${displayName(trace.components[component].name)}` : '';
  const title = kind === 'raw' ? `Weight β${scope}` : `Effective weight${scope}`;
  const stacked = areShares(series);
  const max = Math.max(1, ...series.map(({ values }) => maximum(values)));
  return {
    title,
    unit: '',
    series: series.map((item) => ({ ...item, stacked })),
    ofModalities: true,
    limits: stacked ? [0, 1] : [-0.04 * max, 1.06 * max],
    digits: 2,
  };
}

/** @param {Trace} trace */
function missingWeights({ modalities: [model], fuses, header }) {
  if (fuses) return 'None: this filter does not report its fusion weights.';
  if (model)
    return model.includes('+')
      ? `None: a single measurement model uses ${displayName(model.replaceAll('+', ' and '))}.`
      : `None: ${displayName(model)} is the only modality.`;
  if (header.kind === 'external') return 'None: this filter does not report its modalities.';
  return 'None: the network combines all modalities without explicit weights.';
}

/**
 * @param {Trace} trace
 * @param {number} component
 * @returns {Track}
 */
function estimateTrack(trace, component) {
  const { name } = trace.components[component];
  const estimates = availableSeries(
    trace.sources,
    (source) => trace.nearTruth(source, component),
    (source) => trace.sigma(source, component),
  );
  const truth = { name: 'truth', values: trace.truth(component) };
  return {
    title: capitalised(displayName(name)),
    unit: trace.unitOf(component).unit,
    series: [truth, ...estimates],
    digits: digitsOf([truth, ...estimates]),
  };
}

/**
 * @param {Trace} trace
 * @param {number} component
 * @returns {Track}
 */
function errorTrack(trace, component) {
  if (!trace.truth(component).some(Number.isFinite)) return emptyTrack('Error', NO_TRUTH);
  const isOther = !trace.main.includes(component);
  const name = capitalised(displayName(trace.components[component].name));
  const series = availableSeries(trace.sources, (source) =>
    trace.error(source, isOther ? component : 'main'),
  );
  return {
    title: isOther ? `${name} error` : `${capitalised(trace.task.main.name)} error`,
    unit: isOther ? trace.unitOf(component).unit : trace.mainUnit,
    series,
    fromZero: true,
    digits: digitsOf(series),
  };
}

/**
 * @param {Trace} trace
 * @param {number} component
 * @returns {Track}
 */
function signedErrorTrack(trace, component) {
  if (!trace.truth(component).some(Number.isFinite)) return emptyTrack('Signed error', NO_TRUTH);
  const estimates = availableSeries(
    trace.sources,
    (source) => trace.offset(source, component),
    (source) => trace.sigma(source, component),
  );
  const truth = { name: 'truth', values: new Float32Array(trace.steps) };
  return {
    title: 'Signed error',
    unit: trace.unitOf(component).unit,
    help: 'Estimate minus truth, with the predicted standard deviation. The filter is overconfident where the ±2σ band excludes zero.',
    series: [truth, ...estimates],
    digits: digitsOf(estimates),
  };
}

/**
 * @param {Trace} trace
 * @returns {Track}
 */
function neesTrack(trace) {
  const series = availableSeries(trace.sources, (source) => trace.nees(source));
  const bounds = trace.header.nees_bounds;
  if (!series.length || !bounds) {
    const reason = 'None: this filter has no covariance.';
    return emptyTrack('NEES/n', trace.has('nees') ? NO_TRUTH : reason);
  }
  const [low, high] = [fixed(bounds[0], 2), fixed(bounds[1], 1)];
  return {
    title: 'NEES/n',
    unit: `${low}–${high}`,
    help: `Normalised estimation error squared per component: 1 on average. For a consistent filter 95 % of the steps are between ${low} and ${high}; higher values mean overconfidence.`,
    series,
    bounds,
    log: true,
  };
}

/**
 * @param {Trace} trace
 * @param {number} component
 * @returns {Track}
 */
function innovationTrack(trace, component) {
  const reported = innovationsTrack(trace);
  if (reported) return reported;
  const series = availableSeries(
    trace.modalities,
    (name) => trace.innovation(name, component),
    (name) => trace.innovationSigma(name, component),
  );
  if (!series.length) return emptyTrack('Innovation', missingInnovation(trace.header.kind));
  return {
    title: 'Innovation',
    unit: trace.unitOf(component).unit,
    help: 'Measurement minus prediction of each modality. For a consistent filter 95 % are within the ±2σ band.',
    series: series.map((item) => ({ ...item, aroundZero: Boolean(item.sigma) })),
    ofModalities: true,
    digits: digitsOf(series),
  };
}

/** @param {string} kind of the filter */
const isSequenceModel = (kind) => kind === 'lstm' || kind === 'transformer';

/** @param {string} kind of the filter */
function missingInnovation(kind) {
  if (kind === 'pf')
    return 'None: a particle filter has likelihoods of its particles in place of measurements.';
  if (isSequenceModel(kind)) return 'None: the network has no separate prediction and measurement.';
  return 'None: this filter does not report its predictions and measurements.';
}

/**
 * @param {Trace} trace
 * @returns {Track}
 */
function particleTrack(trace) {
  const values = trace.effectiveSampleSize;
  if (!values) return emptyTrack('Particles', missingParticles(trace.header.kind));
  const count = trace.header.settings?.particles ?? maximum(values);
  return {
    title: 'Particles',
    unit: `of ${count}`,
    help: 'Effective sample size of the particles',
    series: [{ name: 'fused', values }],
    limits: [0, 1.04 * count],
    digits: 0,
  };
}

/** @param {string} kind of the filter */
function missingParticles(kind) {
  if (isSequenceModel(kind)) return 'None: this network has no particles.';
  if (kind === 'external') return 'None: this filter reports no particles.';
  return 'None: a Kalman filter has a Gaussian belief and no particles.';
}

/**
 * @param {string} title
 * @param {string} note
 * @returns {Track}
 */
const emptyTrack = (title, note) => ({ title, unit: '', series: [], note });

/**
 * Returns a series for each name that has values.
 * @param {string[]} names
 * @param {(name: string) => Values | undefined} valuesOf
 * @param {(name: string) => Values | undefined} [sigmaOf]
 * @returns {Series[]}
 */
function availableSeries(names, valuesOf, sigmaOf = () => undefined) {
  return names.flatMap((name) => {
    const values = valuesOf(name);
    return values?.some(Number.isFinite) ? [{ name, values, sigma: sigmaOf(name) }] : [];
  });
}

/** @param {Values} values */
const maximum = (values) => values.reduce((a, b) => Math.max(a, b), 0);

/**
 * Returns the error of the fused estimate in the selected component, or its main error.
 * @param {Trace} trace
 * @param {Pick<State, 'component'>} state
 */
export function selectedError(trace, state) {
  const component = trace.components.findIndex((c) => c.name === state.component);
  return trace.error('fused', trace.main.includes(component) ? 'main' : component);
}

/**
 * Capitalises a name, but not a symbol such as x.
 * @param {string} text
 */
const capitalised = (text) => (text.length > 1 ? text[0].toUpperCase() + text.slice(1) : text);
