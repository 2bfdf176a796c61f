import assert from 'node:assert/strict';
import test from 'node:test';

import { cssVariable } from '../../app/page/core/colours.js';
import { errorSourcesText } from '../../app/page/step/error_sources.js';
import { stepSummary } from '../../app/page/step/step_summary.js';
import { shadeIntervals } from '../../app/page/timeline/chart.js';
import { chartData, valueRange } from '../../app/page/timeline/chart_data.js';
import { secondsAxis } from '../../app/page/timeline/step_axis.js';
import { trackHeights } from '../../app/page/timeline/layout.js';
import { formatValue, legendWidth } from '../../app/page/timeline/legend.js';
import {
  fitWindow,
  formatWindow,
  parseWindow,
  zoomWindow,
} from '../../app/page/timeline/step_window.js';
import { digitsOf } from '../../app/page/timeline/digits.js';
import { TRACKS, selectedError, trackOptions, tracks } from '../../app/page/timeline/tracks.js';
import { FUSION, TASK, makeTrace } from './fixtures.js';

const trace = makeTrace(FUSION);
const state = { component: 'hinge_x', weights: 'effective', track: 'error', charts: '' };

test('windows fit into the episode', () => {
  assert.deepEqual(fitWindow([-5, 15], [0, 100]), [0, 20]);
  assert.deepEqual(fitWindow([95, 105], [0, 100]), [90, 100]);
  assert.deepEqual(fitWindow([50, 51], [0, 100]), [50, 58]);
  assert.deepEqual(fitWindow([-10, 500], [0, 100]), [0, 100]);
  assert.deepEqual(fitWindow([2, 3], [0, 4]), [0, 4]);
});

test('zoom keeps a visible step in place', () => {
  assert.deepEqual(zoomWindow([0, 100], 20, 0.5), [10, 60]);
  assert.deepEqual(zoomWindow([50, 100], 20, 0.5), [50, 75]);
});

test('windows as text', () => {
  assert.equal(formatWindow([0, 100], [0, 100]), '');
  assert.equal(formatWindow([20, 60.25], [0, 100]), '20-60.3');
  assert.deepEqual(parseWindow('20-60.3', [0, 100]), [20, 60.3]);
  assert.deepEqual(parseWindow('', [0, 100]), [0, 100]);
});

test('the timeline has weights, estimates and the selected chart', () => {
  const [weights, estimates, error] = tracks(trace, state);
  assert.equal(weights.title, 'Effective weight, hinge x');
  assert.deepEqual(
    weights.series.map(({ name }) => name),
    ['image', 'haptics'],
  );
  assert.deepEqual(
    estimates.series.map(({ name }) => name),
    ['truth', 'image', 'haptics', 'fused'],
  );
  assert.equal(error.title, 'Position error');
  assert.equal(error.unit, 'cm');
});

test('times of irregular steps', () => {
  assert.equal(trace.seconds(2), 2 * trace.dt);
  assert.equal(trace.stepText, '0.10 s');
  const times = { shape: [4], values: [0, 0.25, 0.5, 1.5] };
  const irregular = makeTrace({ ...FUSION, time: times });
  assert.equal(irregular.seconds(3), 1.5);
  assert.equal(irregular.stepText, '0.25 to 1.00 s');
  const jitter = { shape: [4], values: [0, 0.0487, 0.1, 0.15] };
  assert.equal(makeTrace({ ...FUSION, time: jitter }).stepText, '0.049 to 0.051 s');
  assert.equal(irregular.timestamp(3), 1.5);
  assert.equal(irregular.stepLabel(3), 'step 3 (1.50 s)');
  assert.equal(trace.timestamp(3), null);
  assert.equal(trace.stepLabel(3), 'step 3');
});

test('the axis in seconds is the inverse of its steps and keeps gaps', () => {
  const times = { shape: [4], values: [0, 0.25, 0.5, 1.5] };
  const irregular = makeTrace({ ...FUSION, time: times }, { steps: 4 });
  for (const [run, expected] of /** @type {const} */ ([
    [trace, [-0.05, 0, 0.05, 0.1, 0.25, 0.3, 0.4]],
    [irregular, [-0.05, 0, 0.125, 0.25, 1, 1.5, 1.6]],
  ])) {
    const axis = secondsAxis(run);
    [-0.5, 0, 0.5, 1, 2.5, 3, 4].forEach((step, i) => {
      assert.ok(Math.abs(axis.position(step) - expected[i]) < 1e-6, `${step}`);
      assert.ok(Math.abs(axis.step(axis.position(step)) - step) < 1e-6, `${step}`);
    });
  }
  const [positions] = chartData({ title: '', unit: '', series: [] }, 4, secondsAxis(irregular));
  assert.deepEqual([...positions], times.values);
});

test('times distinguish neighbouring steps', () => {
  assert.equal(trace.timeText(3), '0.3 s');
  const fast = makeTrace(FUSION);
  fast.dt = 0.05;
  assert.equal(fast.timeText(3), '0.15 s');
});

test('missing quantities are explained', () => {
  const plain = makeTrace({ truth: FUSION.truth, estimate_mean: FUSION.estimate_mean });
  for (const track of Object.keys(TRACKS)) {
    const chart = tracks(plain, { ...state, track })[2];
    assert.ok(chart.series.length || chart.note?.startsWith('None: '), track);
  }
  assert.match(tracks(plain, state)[0].note ?? '', /does not report its fusion weights/);
});

test('a comparison run adds its lines', () => {
  const other = makeTrace({ truth: FUSION.truth, estimate_mean: FUSION.estimate_mean });
  const [weights, estimates] = tracks(trace, state, other);
  assert.equal(weights.series.length, 2);
  assert.deepEqual(estimates.series.at(-1)?.comparison, true);
  assert.equal(estimates.series.length, 5);
  const [alone] = tracks(other, state, trace);
  assert.match(alone.title, /, comparison$/, 'the only run with weights');
  assert.ok(alone.series.every(({ stacked, comparison }) => stacked && !comparison));
});

test('estimates of modalities are labelled as updates, weights are not', () => {
  assert.deepEqual(
    trace.sources.map((name) => trace.label(name)),
    ['image-only update', 'haptics-only update', 'fused'],
  );
  const [weights, estimates] = tracks(trace, state);
  assert.ok(weights.ofModalities);
  assert.ok(!estimates.ofModalities);
});

test('a standalone run adds its estimate under its own name and in the colour of its modality', () => {
  const columns = { truth: FUSION.truth, estimate_mean: FUSION.estimate_mean };
  const other = makeTrace(columns, {
    modalities: ['image'],
    settings: { standalone: 'image' },
  });
  const [weights, estimates, error] = tracks(trace, state, other);
  assert.equal(weights.series.length, 2);
  for (const track of [estimates, error]) {
    const line = track.series.at(-1);
    assert.equal(line?.name, 'image standalone');
    assert.ok(line?.comparison);
  }
  assert.equal(cssVariable('image standalone'), '--image');
  assert.deepEqual(trace.inputs, ['image', 'haptics']);
  assert.deepEqual(other.inputs, []);
});

test('the error of the selected component', () => {
  assert.equal(selectedError(trace, state), trace.error('fused', 'main'));
  assert.equal(selectedError(trace, { component: 'angle' }), trace.error('fused', 2));
});

test('chart data has steps, bands and lines', () => {
  const values = Float32Array.of(1, 2);
  const sigma = Float32Array.of(0.5, 1);
  const series = [
    { name: 'truth', values },
    { name: 'fused', values, sigma },
  ];
  const data = chartData({ title: '', unit: '', series }, 2).map((row) => [...row]);
  assert.deepEqual(data, [
    [0, 1],
    [2, 4],
    [0, 0],
    [1, 2],
    [1, 2],
  ]);
});

test('the y axis fits the fused estimate and most values of a modality', () => {
  const fused = { name: 'fused', values: Float32Array.of(0, 10), sigma: Float32Array.of(0, 0) };
  const outlier = Float32Array.from({ length: 200 }, (_, i) => (i === 100 ? 1e6 : 5));
  const track = { title: '', unit: '', series: [fused, { name: 'image', values: outlier }] };
  const [low, high] = valueRange(track, [0, 199]);
  assert.ok(low < 0 && low > -1 && high > 10 && high < 11);
  assert.deepEqual(valueRange({ ...track, limits: [1, 2] }, [0, 1]), [1, 2]);
  assert.deepEqual(valueRange({ ...track, series: [], note: 'None' }, [0, 1]), [0, 1]);
  const bounds = /** @type {[number, number]} */ ([0.1, 3]);
  const log = valueRange({ ...track, series: [fused], log: true, bounds }, [0, 1]);
  assert.ok(log[0] >= 0.01 - 1e-9 && log[1] === 13);
});

test('values in legends', () => {
  const track = { title: '', unit: '', series: [] };
  assert.equal(formatValue(1.2345, track), '1.23');
  assert.equal(formatValue(1.2345, { ...track, digits: 1 }), '1.2');
});

test('values of a small range have more digits', () => {
  const digits = (/** @type {number[]} */ ...values) =>
    digitsOf([{ values: Float32Array.from(values) }]);
  assert.deepEqual(
    [digits(0, 75), digits(50, 51.5), digits(3, NaN, 3.7), digits(0, 1e-9)],
    [1, 2, 2, 3],
  );
  assert.deepEqual([digits(5, 5), digits(), digitsOf([])], [1, 1, 1]);
});

test('legends have room for the longest name, in two columns if it is short', () => {
  const { haptics, full } = { haptics: 'haptics'.length, full: 'haptics-only update'.length };
  assert.ok(legendWidth(trace, [], 'full') > 0.58 * full);
  assert.ok(legendWidth(trace, [], 'compact') > 2 * 0.58 * haptics);
  assert.ok(legendWidth(trace, [], 'dense') > legendWidth(trace, [], 'compact'));
});

test('in a low timeline the chart of areas shrinks first', () => {
  const names = ['fused', 'a', 'b', 'c', 'd', 'e', 'f', 'truth'];
  const lines = { series: names.map((name) => ({ name })) };
  const areas = { series: names.slice(1, 7).map((name) => ({ name, stacked: true })) };
  const low = trackHeights(/** @type {any} */ ([areas, lines, lines]), 177);
  assert.deepEqual(low, [51, 63, 63]);
  const [areaHeight] = trackHeights(/** @type {any} */ ([areas, lines, lines]), 400);
  assert.ok(areaHeight > 84);
});

test('the summary of a step names error, deviation and dominant modality', () => {
  const first = stepSummary(trace, 0, 0);
  assert.equal(first.tone, 'warn');
  assert.equal(
    first.text,
    'Fused error 5.00 cm, 3.0σ in hinge x: larger than predicted. ' +
      'Dominated by image (70 % in hinge x).',
  );
  const second = stepSummary(trace, 1, 0);
  assert.match(second.text, /Dominated by image \(100 % in hinge x\)/);
  const truth = { shape: [2, 3], values: [0.0001, 0, 0, 0, 0, 0] };
  const close = { shape: [2, 3], values: [0, 0, 0, 0, 0, 0] };
  const small = stepSummary(makeTrace({ ...FUSION, truth, estimate_mean: close }), 0, 0);
  assert.match(small.text, /^Fused error 0\.01 cm/, 'not 0.0 cm');
});

test('the summary of a step names the sources of most of its error, the largest first', () => {
  /** @type {[string, number[]][]} */
  const values = [
    ['error', [5, 0]],
    ['image', [1.5, 0.3]],
    ['first belief', [0.4, 0]],
    ['haptics', [4, -0.3]],
    ['dynamics', [-0.9, 0]],
  ];
  const curves = values.map(([name, parts]) => ({
    name,
    values: parts,
    chart: '',
    unit: 'cm',
    layer: '',
    bounds: null,
  }));
  const text = 'By source: haptics 4.00 cm, image 1.50 cm, dynamics -0.90 cm.';
  assert.equal(errorSourcesText(curves, 0).replace('\u2212', '-'), text);
  assert.match(
    stepSummary(trace, 0, 0, text).text,
    /larger than predicted\. Dominated .*\. By source: /,
  );
  assert.equal(errorSourcesText([], 0), '');
});

test('the largest deviation of many components may be larger than that of few', () => {
  const tones = [2.4, 2.6, 5.5, 6].map((sigmas) =>
    [0, 5].map((more) => {
      const components = [...TASK.components, ...Array(more).fill(TASK.components[0])];
      const run = makeTrace(FUSION, { components });
      const largestDeviation = () => ({ sigmas, component: 'hinge_x' });
      return stepSummary(Object.assign(run, { largestDeviation }), 0, 0).tone;
    }),
  );
  const expected = ['good good', 'warn good', 'bad warn', 'bad bad'];
  assert.deepEqual(
    tones,
    expected.map((pair) => pair.split(' ')),
  );
});

test('a variance that is not positive is named, not a number of deviations', () => {
  const run = makeTrace(FUSION);
  const largestDeviation = () => ({ sigmas: Infinity, component: 'hinge_x' });
  const { tone, text } = stepSummary(Object.assign(run, { largestDeviation }), 0, 0);
  assert.equal(tone, 'bad');
  assert.match(text, /; the predicted variance of hinge x is not positive\./);
});

test('an estimate that is not finite is named, not judged', () => {
  const estimate_mean = { shape: [2, 3], values: [NaN, 0, 0, 0, 0, 0] };
  const { tone, text } = stepSummary(makeTrace({ ...FUSION, estimate_mean }), 0, 0);
  assert.equal(tone, 'bad');
  assert.match(text, /^Fused estimate: not a finite number\. /);
});

test('the summary explains an uninformative dominant modality', () => {
  const dark = makeTrace({ ...FUSION, blackout: { shape: [2], values: [1, 1] } });
  assert.match(stepSummary(dark, 1, 0).text, /although the image is blacked out\.$/);
  const truth = { shape: [2, 3], values: [NaN, NaN, 0, NaN, NaN, 0] };
  assert.deepEqual(stepSummary(makeTrace({ truth, estimate_mean: FUSION.estimate_mean }), 0, 0), {
    tone: 'none',
    text: 'True state unknown.',
  });
});

test('the summary names a dominant modality whose update nearly keeps the prediction', () => {
  /** @param {number[]} image sizes of the update of the image at each step, in hinge x */
  const text = (image, more = {}) => {
    const values = image.flatMap((size) => [size, 9, 9, 2, 2, 2]);
    const update_size = { shape: [2, 2, 3], values };
    const run = makeTrace({ ...FUSION, update_size, ...more });
    return [0, 1].map((step) => stepSummary(run, step, 0).text);
  };
  const [small, accurate] = text([0.4, 0.4]);
  assert.match(small, /Dominated by image \(70 % in hinge x\), which nearly keeps the prediction/);
  assert.doesNotMatch(accurate, /keeps/, 'of an accurate estimate, which it may confirm');
  const [dark] = text([0.4, 0.4], { blackout: { shape: [2], values: [1, 1] } });
  assert.match(dark, /nearly keeps the prediction as the image is blacked out\.$/);
  assert.doesNotMatch(text([0.6, 0])[0], /keeps/);
  assert.doesNotMatch(text([NaN, 0])[0], /keeps/);
});

test("a filter's own scalars are charts", () => {
  const arrays = { ...FUSION, 'extra/gain_norm': { shape: [2], values: [0.5, 0.25] } };
  const trace = makeTrace(arrays);
  assert.deepEqual(trackOptions(trace, 'error').at(-1), ['extra/gain_norm', 'gain norm']);
  const lowest = tracks(trace, { ...state, track: 'extra/gain_norm' })[2];
  assert.equal(lowest.title, 'gain norm');
  assert.deepEqual([...lowest.series[0].values], [0.5, 0.25]);
  const missing = { ...state, track: 'extra/other' };
  assert.equal(tracks(trace, missing)[2].note, 'None: this filter does not report it.');
  assert.deepEqual(trackOptions(trace, 'extra/other').at(-1), ['extra/other', 'other']);
});

/** Texts and filled rectangles that `shadeIntervals` draws over 100 steps of 10 px. @param {object} shading */
function shaded(shading) {
  const [texts, rows] = [[], []];
  const tile = { beginPath() {}, moveTo() {}, lineTo() {}, stroke() {} };
  const style = { getPropertyValue: (/** @type {string} */ name) => name };
  Object.assign(globalThis, { devicePixelRatio: 1, getComputedStyle: () => style });
  globalThis.document ??= { createElement: () => ({ getContext: () => tile }) };
  const ctx = {
    save() {},
    restore() {},
    fillRect: (x, y, width, height) => rows.push([x, y, width, height]),
    measureText: (text) => ({ width: 5 * text.length }),
    fillText: (text, x, y) => texts.push([text, x, y]),
    createPattern: () => null,
  };
  const plot = {
    ctx,
    bbox: { left: 0, top: 0, width: 1000, height: 80 },
    valToPos: (step) => 10 * step,
  };
  shadeIntervals(plot, { contact: [], blackout: [], interventions: [], ...shading }, true);
  return { texts, rows };
}

test('injected faults are labelled, below the labels of outages', () => {
  const run = makeTrace(
    { ...FUSION, faulty: { shape: [2], values: [0, 1] } },
    { faults: 'image_frozen:from=1,force_bias:x=5:from=1' },
  );
  assert.deepEqual([...run.faulty], [0, 1]);
  assert.equal(run.faultLabel, 'injected: image frozen, force bias');
  const faults = 'sensor_bias=radar_2:offset=0.2,drop=haptics,blackout=0.4';
  const label = 'injected: sensor bias (radar 2), drop (haptics), blackout';
  assert.equal(makeTrace(FUSION, { faults }).faultLabel, label);
  assert.deepEqual([...makeTrace(FUSION).faulty], [0, 0]);
  const fault = { faulty: [[30, 99]], faultLabel: run.faultLabel };
  const { texts, rows } = shaded(fault);
  assert.deepEqual(rows[0], [295, 0, 700, 4], 'a line at the top edge');
  assert.equal(texts[0][0], 'injected: image frozen, force bias');
  const both = shaded({ ...fault, blackout: [[0, 20]] }).texts;
  assert.deepEqual(
    both.map(([text]) => text),
    ['no image', 'injected: image frozen, force bias'],
  );
  assert.ok(both[1][2] > both[0][2], 'in a row of its own');
  const short = shaded({ ...fault, faulty: [[30, 35]] }).texts;
  assert.equal(short[0][0], 'injected', 'where the names have no room');
});

test('estimates of an angle do not differ from the truth by whole turns', () => {
  const [, { series }] = tracks(trace, { ...state, component: 'angle' });
  const [truth, fused] = ['truth', 'fused'].map(
    (name) => series.find((item) => item.name === name)?.values ?? [],
  );
  const degrees = 180 / Math.PI;
  assert.ok(Math.abs(truth[1] - 3.1 * degrees) < 1e-3);
  assert.ok(Math.abs(fused[1] - (2 * Math.PI - 3.1) * degrees) < 1e-3, 'recorded as -3.1 rad');
  const unknown = makeTrace({ ...FUSION, truth: { shape: [2, 3], values: Array(6).fill(NaN) } });
  const [, { series: alone }] = tracks(unknown, { ...state, component: 'angle' });
  const own = alone.find((item) => item.name === 'fused')?.values ?? [];
  assert.ok(Math.abs(own[1] + 3.1 * degrees) < 1e-3, 'without truth as recorded');
});
