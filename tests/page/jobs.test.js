import assert from 'node:assert/strict';
import { test } from 'node:test';

import './browser.js';
import { jobSummary, remaining } from '../../app/page/widgets/jobs.js';

test('the remaining time follows from the progress so far', () => {
  assert.equal(remaining({ started: 100, progress: 0.25 }, 110), '30 s left');
  assert.equal(remaining({ started: 100, progress: 0.5 }, 400), '5 min left');
  assert.equal(remaining({ started: 100, progress: 0.04 }, 110), '');
  assert.equal(remaining({ started: null, progress: 0.5 }, 110), '');
  assert.equal(remaining({ started: 100, progress: 1 }, 110), '');
});

test('the summary of a running job has progress, activity and remaining time', () => {
  const started = Date.now() / 1000 - 10;
  const job = { state: 'running', progress: 0.2, message: 'step 10 of 100', started };
  assert.match(jobSummary(/** @type {any} */ (job)), /^20 %, step 10 of 100, \d+ s left$/);
});

test('a cancelled fine-tuning is paused', () => {
  const job = { state: 'cancelled', kind: 'finetune', error: '' };
  assert.equal(jobSummary(/** @type {any} */ (job)), 'Paused.');
  assert.equal(jobSummary(/** @type {any} */ ({ ...job, kind: 'failures' })), 'Cancelled.');
});
