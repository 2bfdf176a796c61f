import assert from 'node:assert/strict';
import { test } from 'node:test';

import {
  DEFAULT_CHARTS,
  chartKeys,
  formatCharts,
  moved,
  toggled,
} from '../../app/page/timeline/chart_list.js';
import { trackHeights } from '../../app/page/timeline/layout.js';
import { areShares, upperEdges } from '../../app/page/timeline/stacked_weights.js';
import { withMovedBorder } from '../../app/page/timeline/track_sizes.js';
import { TRACKS, tracks } from '../../app/page/timeline/tracks.js';
import { label, wrapped } from '../../app/page/widgets/plots.js';
import { FUSION, makeTrace } from './fixtures.js';

const trace = makeTrace(FUSION);
const AVAILABLE = Object.keys(TRACKS);
const state = { component: 'hinge_x', weights: 'effective', track: 'error', charts: '' };

/** @param {number[][]} rows */
const series = (...rows) =>
  rows.map((values, i) => ({ name: String(i), values: Float32Array.from(values) }));

test('names of categories are wrapped between words', () => {
  assert.equal(
    wrapped('channels 0 and 2 of gps fix exchanged', 16),
    'channels 0 and 2\nof gps fix\nexchanged',
  );
  assert.equal(wrapped('image', 3), 'image');
});

test('series are stacked if they sum to one at each step', () => {
  assert.ok(areShares(series([0.25, 1, NaN], [0.75, 0, NaN])));
  assert.ok(areShares(series([0.2, 0.1], [0.3, 0.4], [0.5, 0.5])));
  assert.ok(!areShares(series([0.25, 1], [0.75, 0.5])));
  assert.ok(!areShares(series([1.5], [-0.5])), 'a negative area');
  assert.ok(!areShares(series([1, 1])), 'a single series');
  assert.ok(!areShares(series([NaN, 0.5], [1, 0.5])), 'a missing share');
});

test('edges are cumulative sums: differences are the shares, and the last one is one', () => {
  const shares = series([0.25, 0.5], [0.5, 0], [0.25, 0.5]);
  const edges = upperEdges(shares);
  assert.deepEqual([...edges[2]], [1, 1]);
  edges.forEach((edge, i) =>
    edge.forEach((top, t) =>
      assert.equal(
        top - (edges[i - 1]?.[t] ?? 0),
        shares[i].values[t],
        'binary fractions are exact',
      ),
    ),
  );
});

test('weights that sum to one are stacked, also those of a comparison run', () => {
  const [weights, estimates] = tracks(trace, state, trace);
  assert.ok(weights.series.every(({ stacked }) => stacked));
  assert.deepEqual(weights.limits, [0, 1]);
  assert.deepEqual(
    weights.series.map(({ comparison = false }) => comparison),
    [false, false, true, true],
  );
  assert.ok(estimates.series.every(({ stacked }) => !stacked));
  const sums = FUSION.effective_weights.values.map((value) => 2 * value);
  const doubled = makeTrace({ ...FUSION, effective_weights: { shape: [2, 2, 3], values: sums } });
  assert.ok(tracks(doubled, state)[0].series.every(({ stacked }) => !stacked));
});

test('charts are listed, and unknown ones and those twice dropped', () => {
  /** @param {string} charts @param {string} [track] */
  const keys = (charts, track = 'error') => chartKeys({ charts, track }, AVAILABLE);
  assert.deepEqual(keys(''), DEFAULT_CHARTS);
  assert.deepEqual(keys('nonsense'), DEFAULT_CHARTS);
  assert.deepEqual(keys('nees,weights,nees,tea'), ['nees', 'weights']);
  assert.deepEqual(keys('track,error'), ['track'], 'the selected quantity once');
  assert.deepEqual(keys('track,error', 'nees'), ['track', 'error']);
  const titles = tracks(trace, { ...state, charts: 'signed,weights' }).map(({ title }) => title);
  assert.deepEqual(titles, ['Signed error', 'Effective weight, hinge x']);
});

test('charts are added, removed and moved; one always remains', () => {
  for (const keys of [DEFAULT_CHARTS, ['nees'], ['weights', 'nees', 'track']]) {
    const added = toggled(keys, 'innovation');
    assert.deepEqual(toggled(added, 'innovation'), keys);
    for (const key of keys) {
      assert.ok(toggled(keys, key).length >= 1);
      assert.deepEqual(moved(keys, key, 0), keys);
      assert.deepEqual([...moved(keys, key, 1)].sort(), [...keys].sort());
      assert.equal(moved(keys, key, -9)[0], key);
      assert.equal(moved(keys, key, 9).at(-1), key);
    }
    const text = formatCharts(keys);
    assert.deepEqual(chartKeys({ charts: text, track: 'error' }, AVAILABLE), keys);
  }
  assert.equal(formatCharts(DEFAULT_CHARTS), '');
});

test('charts fill the height; that with a band gets more, and low timelines shrink all', () => {
  const list = tracks(trace, state);
  for (const height of [90, 160, 240, 600]) {
    const heights = trackHeights(list, height);
    const sum = heights.reduce((a, b) => a + b, 0);
    assert.ok(sum <= height && sum > height - list.length, `${heights}`);
    assert.ok(heights.every((value) => value > 0));
  }
  assert.ok(trackHeights(list, 177)[1] >= 60, 'the estimate in a window of 1280 x 720 px');
  const [low, high] = [240, 340].map((height) => trackHeights(list, height));
  const grown = high.map((value, i) => value - low[i]);
  assert.ok(grown[1] > 1.5 * grown[0] && grown[0] > 0);
});

test('moving a border keeps the sum and the other charts, within the limits, and back', () => {
  const heights = [60, 80, 50];
  for (const [index, change] of [
    [0, 20],
    [0, -500],
    [1, 500],
    [1, -10],
  ]) {
    const result = withMovedBorder(heights, index, change);
    assert.equal(result[0] + result[1] + result[2], 190);
    assert.ok(result.every((height) => height >= 28));
    const actual = result[index] - heights[index];
    assert.ok(Math.sign(actual) === Math.sign(change) && Math.abs(actual) <= Math.abs(change));
    assert.deepEqual(withMovedBorder(result, index, -actual), heights);
  }
  assert.deepEqual(withMovedBorder([10, 10], 0, 5), [10, 10], 'both are too low');
});

test('labels have spaces in joined names and none in numbers', () => {
  assert.equal(label('image+haptics'), 'image + haptics');
  for (const text of ['+9.27 %', '8.22e+04 nats']) assert.equal(label(text), text);
});
