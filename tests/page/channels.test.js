import assert from 'node:assert/strict';
import { test } from 'node:test';

import { chartKeys } from '../../app/page/timeline/chart_list.js';
import { chartData, isolatedSteps, valueRange } from '../../app/page/timeline/chart_data.js';
import { channelOptions, measuredChannels } from '../../app/page/timeline/channel_tracks.js';
import { trackHeights } from '../../app/page/timeline/layout.js';
import { readingCharts } from '../../app/page/timeline/reading_charts.js';
import { chartOptions, tracks } from '../../app/page/timeline/tracks.js';
import { FUSION, encodeColumns, makeTrace } from './fixtures.js';

/** @typedef {import('../../app/page/types/api.js').Component} Component */

/** @param {string} name @param {string} unit @param {string} displayed @param {number} scale */
const channel = (name, unit = '', displayed = unit, scale = 1) =>
  /** @type {Component} */ ({ name, unit, display_unit: displayed, scale });
const RADAR = [channel('radar range', 'm', 'cm', 100), channel('radar bearing', 'rad', 'deg', 10)];
const FORCE = ['x', 'y'].map((axis) => channel(`force ${axis}`, 'N'));
const GAP = [1, NaN, 2, NaN];
const ARRAYS = {
  ...FUSION,
  'readings/radar': { shape: [2, 2], values: [1, 0.5, 2, 0.25], channels: RADAR },
  'readings/force': { shape: [2, 2], values: GAP, channels: FORCE },
  'readings/control': { shape: [2, 1], values: [3, 4], channels: [channel('control')] },
};
const MEASURED = {
  'innovation/radar': { shape: [2, 2], values: [0.5, 2, NaN, NaN], channels: RADAR },
  'innovation_sigma/radar': { shape: [2, 2], values: [0.25, 1, NaN, NaN], channels: RADAR },
  'innovation/compass': {
    shape: [2, 2],
    values: [1, NaN, 2, NaN],
    channels: [channel('channel 0'), channel('channel 1')],
  },
  'innovation_sigma/compass': {
    shape: [2, 2],
    values: [1, NaN, 1, NaN],
    channels: [channel('channel 0'), channel('channel 1')],
  },
};
const trace = makeTrace(ARRAYS);
const measured = makeTrace({ ...FUSION, ...MEASURED });
const state = { component: 'hinge_x', weights: 'effective', track: 'error', charts: '' };
/** @param {typeof trace} run @param {string} key @param {typeof trace} [other] */
const chartOf = (run, key, other) => tracks(run, { ...state, charts: key }, other)[0];

test('residuals of channels that measure a component are a chart', () => {
  const gps = [channel('gps x', 'm', 'cm', 100)];
  const run = makeTrace({
    ...FUSION,
    'residual/gps': { shape: [2, 1], values: [0.5, NaN], channels: gps },
  });
  assert.deepEqual(channelOptions(run), [['residual/gps', 'residual of gps']]);
  const chart = chartOf(run, 'residual/gps');
  assert.equal(chart.title, 'Gps minus truth');
  assert.equal(chart.unit, 'cm');
  assert.deepEqual(
    chart.series.map(({ name, values }) => [name, [...values]]),
    [['x', [50, NaN]]],
  );
});

test('readings and controls are charts that are off by default', () => {
  assert.deepEqual(channelOptions(trace), [
    ['readings/radar', 'readings of radar'],
    ['readings/force', 'readings of force'],
    ['readings/control', 'controls'],
  ]);
  const keys = chartOptions(trace, 'error').map(([key]) => key);
  assert.ok(!chartKeys(state, keys).some((key) => key.startsWith('readings/')));
  assert.deepEqual(chartKeys({ ...state, charts: 'readings/force' }, keys), ['readings/force']);
  assert.equal(chartOf(trace, 'readings/control').title, 'Controls');
  const absent = tracks(makeTrace(FUSION), { ...state, charts: 'weights,readings/gps' });
  assert.deepEqual(
    absent.map(({ key }) => key),
    ['weights'],
  );
});

test('a chart of readings has a line for each channel, in the units for display', () => {
  const force = chartOf(trace, 'readings/force');
  assert.equal(force.title, 'Force readings');
  assert.equal(force.unit, 'N');
  assert.deepEqual(
    force.series.map(({ name, line }) => [name, line]),
    [
      ['x', 0],
      ['y', 1],
    ],
  );
  const radar = chartOf(trace, 'readings/radar');
  assert.equal(radar.unit, '', 'channels with different units have them in their names');
  assert.deepEqual(
    radar.series.map(({ name, values }) => [name, [...values]]),
    [
      ['range (cm)', [100, 200]],
      ['bearing (°)', [5, 2.5]],
    ],
  );
});

test('missing readings are gaps, and single ones between gaps are points', () => {
  const [, x, y] = chartData(chartOf(trace, 'readings/force'), 2);
  assert.deepEqual([...x], [1, 2]);
  assert.deepEqual(y, [null, null]);
  const plot = /** @type {uPlot} */ ({ data: [[], [1, null, 2, 3, null, 4, null, null]] });
  assert.deepEqual(isolatedSteps(plot, 1), [0, 5]);
  assert.equal(isolatedSteps(/** @type {uPlot} */ ({ data: [[], [1, 2, null]] }), 1), null);
});

test('a legend of many channels leaves room for the other charts', () => {
  const channels = Array.from({ length: 16 }, (_, i) => channel(`joints ${i}`));
  const many = { shape: [2, 16], values: new Array(32).fill(0), channels };
  const arm = makeTrace({ ...FUSION, 'readings/joints': many });
  const list = tracks(arm, { ...state, charts: 'estimate,readings/joints' });
  const [estimate, joints] = trackHeights(list, 300);
  assert.ok(estimate > 100 && joints > 100);
});

test('a comparison run adds its readings', () => {
  const other = makeTrace({ ...ARRAYS, 'readings/force': { ...ARRAYS['readings/force'] } });
  const { series } = chartOf(trace, 'readings/force', other);
  assert.deepEqual(
    series.map(({ name, line, comparison = false }) => [name, line, comparison]),
    [
      ['x', 0, false],
      ['y', 1, false],
      ['x', 0, true],
      ['y', 1, true],
    ],
  );
});

test('reported innovations are lines by modality and channel with bands around zero', () => {
  const chart = chartOf(measured, 'innovation');
  assert.deepEqual(
    chart.series.map(({ name }) => name),
    ['radar range (cm)', 'radar bearing (°)', 'compass channel 0'],
  );
  const [range] = chart.series;
  assert.deepEqual([...range.values], [50, NaN]);
  assert.deepEqual([...(range.sigma ?? [])], [25, 25], 'held between measurements');
  const data = chartData(chart, 2);
  assert.deepEqual([...data[1]], [50, 50]);
  assert.deepEqual([...data[2]], [-50, -50]);
  const [low, high] = valueRange({ ...chart, series: [range] }, [0, 1]);
  assert.ok(low < -50 && high > 50);
  assert.deepEqual(channelOptions(measured), [
    ['innovation/radar', 'innovation of radar'],
    ['innovation/compass', 'innovation of compass'],
  ]);
  assert.deepEqual(
    chartOf(measured, 'innovation/compass').series.map(({ name }) => name),
    ['compass channel 0'],
  );
  assert.equal(measuredChannels(measured, 'innovation/compass').length, 1);
});

test('channels of a live run keep the names of the first measurement', () => {
  const unnamed = [channel('channel 0'), channel('channel 1')];
  const live = makeTrace({
    ...FUSION,
    'innovation/radar': { shape: [2, 2], values: [NaN, NaN, NaN, NaN], channels: unnamed },
  });
  assert.deepEqual(live.channels.innovation('innovation/radar'), []);
  for (const [values, channels] of /** @type {[number[], Component[]][]} */ ([
    [[1, 2], RADAR],
    [[NaN, NaN], unnamed],
  ])) {
    const block = encodeColumns({ 'innovation/radar': { shape: [1, 2], values, channels } });
    live.grow({ ...block, steps: 1, images: null });
    assert.deepEqual(
      live.channels.of('innovation/radar').map(({ name }) => name),
      ['radar range', 'radar bearing'],
    );
  }
});

test('an offered chart of readings is added once, below the others', () => {
  const store = /** @type {any} */ ({
    state: { ...state },
    set(/** @type {object} */ patch) {
      Object.assign(this.state, patch);
    },
  });
  const charts = readingCharts(store, () => trace);
  assert.ok(charts.has('force') && !charts.has('image') && !charts.has(''));
  charts.show('force');
  charts.show('force');
  assert.equal(store.state.charts, 'weights,estimate,track,readings/force');
  assert.ok(!readingCharts(store, () => null).has('force'));
});
