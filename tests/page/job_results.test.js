import assert from 'node:assert/strict';
import { test } from 'node:test';

import './browser.js';
import {
  EPISODES,
  isTrainable,
  placeLabel,
  recoveredText,
} from '../../app/page/tabs/diagnosis_cause.js';
import { JobResults } from '../../app/page/widgets/job_results.js';

const { signal } = new AbortController();

/** @param {string} state */
const job = (state) => /** @type {any} */ ({ id: 'a', state });

/**
 * Lets the server answer all requests in the same way.
 * @param {object | null} body JSON; null: the request is not expected
 * @param {number} [status]
 */
function answer(body, status = 200) {
  globalThis.fetch = async (_, options) => {
    options?.signal?.throwIfAborted();
    return body ? Response.json(body, { status }) : assert.fail('the result is known');
  };
}

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
  answer({ job: null });
  await results.load('run', '/run', signal);
  assert.equal(results.get('run').state, 'absent');
  answer({ job: job('waiting') });
  await results.startOrCancel('run', '/run');
  assert.equal(results.get('run').state, 'active');
  answer(null);
  await results.startOrCancel('run', '/run');
  assert.deepEqual(cancelled, ['a']);
  update(job('failed'));
  assert.equal(results.get('run').state, 'ended');
  update(job('done'));
  assert.deepEqual(finished, ['run']);
  answer({ value: 1 });
  await results.load('run', '/run', signal);
  assert.deepEqual(results.get('run'), { state: 'ready', result: { value: 1 } });
  answer(null);
  await results.load('run', '/run', signal);
});

test('a job that another page starts is followed', async () => {
  const { results, finished, update } = setUp();
  answer({ job: null });
  await results.load('run', '/run', signal);
  update();
  assert.equal(results.get('run').state, 'absent');
  answer({ job: job('running') });
  update(job('running'));
  await new Promise(setImmediate);
  assert.equal(results.get('run').state, 'active');
  answer(null);
  update(job('done'));
  assert.deepEqual(finished, ['run']);
});

test('a preliminary result is kept until the result replaces it', async () => {
  const { results, update } = setUp();
  const preliminary = { value: 0 };
  answer({ job: null, preliminary });
  await results.load('run', '/run', signal);
  answer({ job: job('waiting') });
  await results.startOrCancel('run', '/run');
  for (const state of ['running', 'done']) {
    update(job(state));
    assert.deepEqual(results.get('run').preliminary, preliminary);
  }
  answer({ value: 1 });
  await results.load('run', '/run', signal);
  assert.deepEqual(results.get('run'), { state: 'ready', result: { value: 1 } });
});

test('an error is kept, an aborted request is not, and the oldest result is dropped', async () => {
  const { results } = setUp();
  answer({ error: 'no such filter' }, 404);
  await results.load('one', '/one', signal);
  assert.deepEqual(results.get('one'), {
    state: 'error',
    error: 'No such filter.',
    isRefusal: false,
  });
  await results.load('two', '/two', AbortSignal.abort());
  assert.equal(results.get('two').state, 'loading');
  answer({});
  await results.load('three', '/three', signal);
  assert.equal(results.get('one').state, 'loading');
});

test('a request that the server refused cannot be tried again, unlike one that failed', async () => {
  const { results } = setUp();
  for (const [status, isRefusal] of [
    [400, true],
    [429, false],
    [500, false],
  ]) {
    answer({ error: '5 held-out episodes' }, Number(status));
    await results.startOrCancel('run', '/run');
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
  assert.equal(placeLabel(place, EPISODES), 'episode 9, step 39');
  assert.equal(placeLabel(place, null), 'step 39');
  assert.equal(placeLabel({ ...place, step: null }, EPISODES), 'episode 9');
  assert.equal(placeLabel({ ...place, step: null }, null), '');
  const runs = { noun: 'run', name: (index) => `day_${index}` };
  assert.equal(placeLabel(place, runs), 'run day_9, step 39');
});
