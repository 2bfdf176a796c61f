import assert from 'node:assert/strict';
import test from 'node:test';

import { decodeBlock } from '../../app/page/data/live_stream.js';
import { intervals, slice } from '../../app/page/data/arrays.js';
import { FUSION, encodeColumns, makeTrace } from './fixtures.js';

/** @param {ArrayLike<number> | undefined} values @param {number[]} expected */
function assertClose(values, expected) {
  assert.equal(values?.length, expected.length);
  expected.forEach((value, i) => assert.ok(Math.abs((values?.[i] ?? NaN) - value) < 1e-4));
}

test('slice selects an index of the axes after the first', () => {
  const data = Float32Array.from({ length: 12 }, (_, i) => i);
  assert.deepEqual([...slice({ data, shape: [2, 2, 3] }, [1, 2])], [5, 11]);
  assert.deepEqual([...slice({ data, shape: [12] }, [])], [...data]);
});

test('columns are decoded to cm and degrees', () => {
  const trace = makeTrace(FUSION);
  assertClose(trace.truth(0), [0, 10]);
  assertClose(trace.mean('fused', 2), [0, (-3.1 * 180) / Math.PI]);
  assertClose(trace.mean('haptics', 0), [30, 10]);
  assertClose(trace.sigma('fused', 0), [1, 3]);
  assert.equal(trace.sigma('image', 0), undefined);
  assert.deepEqual(trace.sources, ['image', 'haptics', 'fused']);
});

test('errors are distances, and angles are wrapped', () => {
  const trace = makeTrace(FUSION);
  assertClose(trace.error('fused', 'main'), [5, 0]);
  assertClose(trace.error('haptics', 'main'), [30, 10]);
  const wrapped = 360 - (6.2 * 180) / Math.PI;
  assertClose(trace.error('fused', 2), [0, wrapped]);
  assertClose(trace.mainSigma('fused'), [Math.hypot(1, 2), 5]);
  assert.deepEqual(trace.largestDeviation(0)?.component, 'hinge_x');
  assert.ok(Math.abs((trace.largestDeviation(0)?.sigmas ?? 0) - 3) < 1e-4);
});

test('weights are shared by all components or separate', () => {
  const trace = makeTrace(FUSION);
  assertClose(trace.weight('raw', 'image', 2), [0.5, 0.2]);
  const common = makeTrace({
    ...FUSION,
    weights: { shape: [2, 2, 1], values: [0.9, 0.1, 0.2, 0.8] },
  });
  assertClose(common.weight('raw', 'image', 2), [0.9, 0.2]);
  assert.deepEqual([trace.weightWidth, common.weightWidth], [3, 1]);
  assertClose(trace.weight('effective', 'haptics', 1), [0.4, 0]);
  assert.equal(trace.weight('raw', 'sound', 0), undefined);
});

test('images of the first sensor', () => {
  const images = Uint8Array.from([0, 0, 0, 0, 0, 7, 0, 0]).buffer;
  const sensors = [{ name: 'image', height: 2, width: 2, channels: 1, low: null, high: null }];
  const trace = makeTrace(FUSION, { sensors }, images);
  assert.deepEqual([...(trace.image(1) ?? [])], [0, 7, 0, 0]);
});

test('a live trace grows, and missing values are NaN', () => {
  const { truth } = FUSION;
  const trace = makeTrace({ truth, contact: FUSION.contact });
  const block = encodeColumns({
    truth: { shape: [1, 3], values: [0.5, 0, 0] },
    nees: { shape: [1, 3], values: [1, 2, 3] },
  });
  assert.equal(trace.grow({ ...block, steps: 1, images: null }), true);
  assert.equal(trace.steps, 3);
  assertClose(trace.truth(0), [0, 10, 50]);
  assert.deepEqual([...(trace.nees('fused') ?? [])], [NaN, NaN, 3]);
  assert.deepEqual([...trace.contact], [0, 1, NaN]);
  assert.equal(trace.grow({ ...block, steps: 1, images: null }), false);
  assertClose(trace.truth(0), [0, 10, 50, 50]);
});

test('a block of a live run is decoded', () => {
  const header = new TextEncoder().encode(JSON.stringify({ first: 3, steps: 1, image_bytes: 2 }));
  const padding = -header.length & 3;
  const message = new Uint8Array(4 + header.length + padding + 4 + 2);
  new DataView(message.buffer).setUint32(0, header.length, true);
  message.set(header, 4);
  message.set([1, 2, 3, 4, 8, 9], 4 + header.length + padding);
  const block = decodeBlock(message.buffer);
  assert.equal(block.first, 3);
  assert.deepEqual([...new Uint8Array(block.buffer)], [1, 2, 3, 4]);
  assert.deepEqual([...new Uint8Array(block.images ?? new ArrayBuffer(0))], [8, 9]);
});

test('intervals of set flags', () => {
  assert.deepEqual(intervals([0, 1, 1, 0, 1]), [
    [1, 2],
    [4, 4],
  ]);
  assert.deepEqual(intervals([]), []);
});
