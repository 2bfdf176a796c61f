import assert from 'node:assert/strict';
import { test } from 'node:test';

import './browser.js';
import { ServerError } from '../../app/page/data/server_error.js';
import { isTrainable, placeLabel, recoveredText } from '../../app/page/tabs/diagnosis_cause.js';
import { JobResults } from '../../app/page/widgets/job_results.js';

const { signal } = new AbortController();

/** @param {string} state */
const job = (state) => /** @type {any} */ ({ id: 'a', state });

/** Results with a list of jobs that the test controls. */
function setUp(capacity = 2) {
  /** @type {(list: any[]) => void} */
  let update = () => {};
  /** @type {string[]} */
  const [cancelled, finished] = [[], []];
  const jobs = /** @type {any} */ ({
    listen: (/** @type {typeof update} */ listener) => (update = listener),
    cancel: (/** @type {string} */ id) => cancelled.push(id),
    refresh() {},
  });
  const results = new JobResults(jobs, capacity, (keys) => finished.push(...keys));
  return { results, cancelled, finished, update: (/** @type {any[]} */ ...list) => update(list) };
}

test('a job is started, followed and cancelled; its result is loaded again when it is done', async () => {
  const { results, cancelled, finished, update } = setUp();
  await results.load('run', async () => ({ job: null }), signal);
  assert.equal(results.get('run').state, 'absent');
  await results.startOrCancel('run', async () => ({ job: job('waiting') }));
  assert.equal(results.get('run').state, 'active');
  await results.startOrCancel('run', () => assert.fail('it is active'));
  assert.deepEqual(cancelled, ['a']);
  update(job('failed'));
  assert.equal(results.get('run').state, 'ended');
  update(job('done'));
  assert.deepEqual(finished, ['run']);
  await results.load('run', async () => ({ value: 1 }), signal);
  assert.deepEqual(results.get('run'), { state: 'ready', result: { value: 1 } });
  await results.load('run', () => assert.fail('it is known'), signal);
});

test('a preliminary result is kept until the result replaces it', async () => {
  const { results, update } = setUp();
  const preliminary = { value: 0 };
  await results.load('run', async () => ({ job: null, preliminary }), signal);
  await results.startOrCancel('run', async () => ({ job: job('waiting') }));
  for (const state of ['running', 'done']) {
    update(job(state));
    assert.equal(results.get('run').preliminary, preliminary);
  }
  await results.load('run', async () => ({ value: 1 }), signal);
  assert.deepEqual(results.get('run'), { state: 'ready', result: { value: 1 } });
});

test('an error is kept, an aborted request is not, and the oldest result is dropped', async () => {
  const { results } = setUp();
  const fail = () => Promise.reject(new Error('no such filter'));
  await results.load('one', fail, signal);
  assert.deepEqual(results.get('one'), {
    state: 'error',
    error: 'no such filter',
    isRefusal: false,
  });
  await results.load('two', fail, AbortSignal.abort());
  assert.equal(results.get('two').state, 'loading');
  await results.load('three', async () => ({}), signal);
  assert.equal(results.get('one').state, 'loading');
});

test('a request that the server refused cannot be tried again, unlike one that failed', async () => {
  const { results } = setUp();
  for (const [status, isRefusal] of [
    [400, true],
    [429, false],
    [0, false],
  ]) {
    const error = new ServerError('5 held-out episodes', Number(status));
    await results.startOrCancel('run', () => Promise.reject(error));
    assert.deepEqual(results.get('run'), {
      state: 'error',
      error: '5 held-out episodes.',
      isRefusal,
    });
  }
});

test('the effect of undoing a cause has a direction and no sign', () => {
  const effect = { error: null, low: null, high: null, measure: 'position' };
  assert.match(recoveredText({ ...effect, nll: -0.154 }), /increases by 0\.15 nats/);
  assert.match(recoveredText({ ...effect, nll: 0.154 }), /decreases by 0\.15 nats/);
  const angle = { error: 0.6, low: 0.5, high: 0.7, nll: 1, measure: 'angle' };
  assert.match(
    recoveredText(angle),
    /^Undoing it removes 60 % \(50 % to 70 %\) of the angle error;/,
  );
  assert.match(
    recoveredText({ ...angle, error: -0.2 }),
    /^Undoing it does not help: the angle error increases by 20 %;/,
  );
  for (const error of [-0.004, 0, 0.004])
    assert.match(recoveredText({ ...angle, error }), /^Undoing it does not change the error; the/);
});

test('only a cause whose next action is a fine-tuning run offers one', () => {
  assert.ok(
    isTrainable({ next: 'Fine-tune it: `beliefscope finetune door --filter crossmodal-ekf`.' }),
  );
  assert.ok(!isTrainable({ next: 'Check the camera and its driver.' }));
});

test('an evidence names its episode only among others', () => {
  const place = { episode: 9, step: 39, time: null };
  assert.equal(placeLabel(place, false), 'episode 9, step 39');
  assert.equal(placeLabel(place, true), 'step 39');
  assert.equal(placeLabel({ ...place, step: null }, false), 'episode 9');
  assert.equal(placeLabel({ ...place, step: null }, true), '');
});
