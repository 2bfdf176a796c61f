import assert from 'node:assert/strict';
import { test } from 'node:test';

import { LAYOUTS } from '../../app/page/core/layouts.js';
import {
  LIMITS,
  parseSizes,
  permittedShare,
  shareAfterKey,
} from '../../app/page/core/pane_sizes.js';
import { TABS } from '../../app/page/core/state.js';

const PANES = /** @type {import('../../app/page/core/pane_sizes.js').Pane[]} */ (
  Object.keys(LIMITS)
);

test('a permitted share is within the limits, or zero, and permitted itself', () => {
  for (const pane of PANES)
    for (let share = -0.2; share < 1.2; share += 0.01) {
      const [min, max] = LIMITS[pane];
      const result = permittedShare(pane, share);
      assert.ok(result === 0 || (result >= min && result <= max));
      assert.equal(permittedShare(pane, result), result);
      if (share >= min && share <= max) assert.equal(result, share);
    }
});

test('sizes of other versions and broken ones are dropped', () => {
  assert.deepEqual(parseSizes('{"side":0.5,"other":0.5,"step":"0.2","timeline":9}'), {
    side: 0.5,
    timeline: LIMITS.timeline[1],
  });
  for (const text of [null, '', 'nonsense', 'null', '[]', '3'])
    assert.deepEqual(parseSizes(text), {});
});

test('keys reach every size from any other and undo each other', () => {
  for (const pane of PANES)
    for (const isVertical of [true, false]) {
      const [grow, shrink] = isVertical ? ['ArrowLeft', 'ArrowRight'] : ['ArrowUp', 'ArrowDown'];
      const [min, max] = LIMITS[pane];
      const middle = (min + max) / 2;
      /** @param {string} key @param {number} share @param {boolean} [isLarge] */
      const after = (key, share, isLarge = false) =>
        Number(shareAfterKey(pane, share, key, isVertical, isLarge));
      assert.ok(Math.abs(after(shrink, after(grow, middle)) - middle) < 1e-12);
      let share = 0;
      for (let i = 0; i < 60; i++) share = after(grow, share);
      assert.equal(share, max);
      for (let i = 0; i < 60; i++) share = after(shrink, share);
      assert.equal(share, 0);
      assert.deepEqual([after('Home', share), after('End', share)], [min, max]);
      assert.equal(shareAfterKey(pane, middle, 'a', isVertical, false), null);
      const other = isVertical ? 'ArrowUp' : 'ArrowLeft';
      assert.equal(shareAfterKey(pane, middle, other, isVertical, false), null);
    }
});

test('layouts have permitted sizes and existing tabs', () => {
  for (const { sizes, tab } of LAYOUTS) {
    assert.ok(TABS.includes(tab));
    assert.deepEqual(parseSizes(JSON.stringify(sizes)), sizes);
  }
});
