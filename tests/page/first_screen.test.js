import assert from 'node:assert/strict';
import { test } from 'node:test';

import './browser.js';
import { outageFinding } from '../../app/page/step/finding.js';

const STEPS = 20;

/** @param {(step: number) => number} value */
const series = (value) => Float32Array.from({ length: STEPS }, (_, t) => value(t));

/**
 * A run whose camera is dark from step 8 to `last`, in contact from `contact` on.
 * @param {number} last
 * @param {number} [contact]
 */
const run = (last, contact = 5) =>
  /** @type {any} */ ({
    steps: STEPS,
    modalities: ['image', 'haptics'],
    blackout: series((t) => Number(t >= 8 && t <= last)),
    contact: series((t) => Number(t >= contact)),
    weight: () => series((t) => (t >= 8 && t <= last ? 0.9 : 0.25)),
    error: () => series((t) => (t === 10 ? 1.23 : 0.5)),
  });

test('the finding describes the outage in contact, with weights, error and its end', () => {
  assert.equal(
    outageFinding(run(14), 0),
    'The camera goes dark at step 8, in contact; the effective weight of haptics rises from 25 % to 90 %; ' +
      'the position error stays below 1.3 cm; the image returns at step 15.',
  );
  assert.match(outageFinding(run(STEPS - 1), 0), /; it stays dark\.$/);
});

test('short outages and those in free motion are no finding', () => {
  assert.equal(outageFinding(run(11), 0), '');
  assert.equal(outageFinding(run(14, 9), 0), '');
});
