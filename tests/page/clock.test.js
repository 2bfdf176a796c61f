import assert from 'node:assert/strict';
import test from 'node:test';

import { runFrames } from './browser.js';
import { Clock } from '../../app/page/core/clock.js';
import { Store, parsePermalink } from '../../app/page/core/state.js';
import { CATALOG } from './fixtures.js';

const STEPS = 20;
const DT = 0.1; // s

/**
 * Plays frames of the duration of a step, and returns the displayed steps and whether the playback goes on.
 * @param {{step: number, window?: string}} selection
 * @param {number} frames
 * @param {(step: number) => number} [seconds]
 */
function play(selection, frames, seconds = (step) => DT * step) {
  let now = 0; // ms
  performance.now = () => now;
  const store = new Store({ ...parsePermalink('', CATALOG).state, window: '', ...selection });
  const clock = new Clock(store);
  clock.show(/** @type {any} */ ({ steps: STEPS, seconds }));
  clock.toggle();
  store.flush();
  const steps = [];
  for (let frame = 0; frame < frames; frame += 1) {
    // A little more than a step: the sum of floats must not fall below it.
    now += 1000 * DT + 0.01;
    runFrames(now);
    steps.push(store.state.step);
  }
  return { steps, playing: store.state.playing };
}

test('playback ends at the last step', () => {
  assert.deepEqual(play({ step: 16 }, 5), { steps: [17, 18, 19, 19, 19], playing: false });
  assert.deepEqual(play({ step: 19 }, 2), { steps: [1, 2], playing: true });
});

test('playback repeats the visible steps', () => {
  const window = '4.5-8.2';
  assert.deepEqual(play({ step: 6, window }, 6), { steps: [7, 8, 5, 6, 7, 8], playing: true });
  assert.deepEqual(play({ step: 15, window }, 2), { steps: [6, 7], playing: true });
});

test('equal or missing times do not repeat without end', () => {
  assert.equal(play({ step: 6, window: '4-9' }, 2, () => 0).playing, true);
  assert.deepEqual(play({ step: 6, window: '4-9' }, 2, () => NaN).steps, [6, 6]);
});
