/** Data slices in words. */

import assert from 'node:assert/strict';
import test from 'node:test';

import { conditionText, sliceSentence } from '../../app/page/tabs/slice_table.js';

const CONDITION = { covariate: 'true angle', unit: 'deg', low: null, high: null, category: null };

test('conditions have the units of the page', () => {
  const text = (change) => conditionText({ ...CONDITION, ...change });
  assert.equal(text({ low: 22.5 }), 'true angle >\u00a022.5°');
  assert.equal(
    text({ high: -50, covariate: 'true hinge x', unit: 'cm' }),
    'true hinge x ≤\u00a0−50\u00a0cm',
  );
  assert.equal(
    text({ low: 1, high: 2, covariate: 'outage length', unit: 's' }),
    '1\u00a0s\u00a0< outage length ≤\u00a02\u00a0s',
  );
  assert.equal(text({ low: 3.9, covariate: 'time', unit: 's' }), 'time >\u00a03.9\u00a0s');
  assert.equal(text({ low: 0.6234, covariate: 'friction', unit: '' }), 'friction >\u00a00.623');
  assert.equal(text({ category: 'no', covariate: 'contact' }), 'free motion');
  assert.equal(text({ category: 'no fix', covariate: 'fix' }), 'no fix');
  assert.equal(text({ category: 'fix', covariate: 'fix' }), 'fix');
  assert.equal(text({ category: 'no', covariate: 'blackout' }), 'no blackout');
  assert.equal(text({ category: 'yes', covariate: 'contact' }), 'contact');
  assert.equal(text({ category: 'push', covariate: 'policy' }), 'policy is push');
});

test('a slice without an interval, and with one', () => {
  const slice = {
    conditions: [{ ...CONDITION, category: 'yes', covariate: 'blackout' }],
    ratio: 1.5499,
    low: null,
    high: null,
    inside: 0.02,
    outside: 0.0129,
    episodes: [3, 5],
    worst: [3, 17],
    steps: 20,
    share: 0.204,
    p_value: 0.01,
  };
  const score = {
    name: 'error',
    title: 'position error',
    unit: 'm',
    display_unit: 'cm',
    scale: 100,
  };
  const end = 'where blackout: 2 of 9 episodes, 20 % of steps.';
  assert.equal(sliceSentence(slice, score, 9), `Position error is 1.5 times as large ${end}`);
  assert.equal(
    sliceSentence({ ...slice, low: 1.34, high: 1.7 }, score, 9),
    `Position error is 1.5 times as large (1.3 to 1.7) ${end}`,
  );
});
