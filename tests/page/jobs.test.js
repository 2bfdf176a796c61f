import assert from 'node:assert/strict';
import { test } from 'node:test';

import './browser.js';
import { jobSummary, timeLeft } from '../../app/page/widgets/jobs.js';

test('the remaining time has seconds or minutes', () => {
  assert.equal(timeLeft(29.5), '30 s left');
  assert.equal(timeLeft(300), '5 min left');
  assert.equal(timeLeft(null), '');
});

test('the summary of a running job has progress, activity and remaining time', () => {
  const job = { state: 'running', progress: 0.2, message: 'step 10 of 100', remaining: 40 };
  assert.equal(jobSummary(/** @type {any} */ (job)), '20 %, step 10 of 100, 40 s left');
});

test('a cancelled fine-tuning is paused', () => {
  const job = { state: 'cancelled', kind: 'finetune', error: '' };
  assert.equal(jobSummary(/** @type {any} */ (job)), 'Paused.');
  assert.equal(jobSummary(/** @type {any} */ ({ ...job, kind: 'failures' })), 'Cancelled.');
});
