/** @import { Success } from '../../app/page/types/server.js' */

import assert from 'node:assert/strict';
import test from 'node:test';

import { spanProblem } from '../../app/page/tabs/comparison_form.js';
import { promoteText } from '../../app/page/tabs/finetune_run.js';
import { notExcluded, outcomeView } from '../../app/page/tabs/finetune_runs.js';
import { inOrder, verdictStatus } from '../../app/page/tabs/diagnostics.js';
import { episodeNote } from '../../app/page/tabs/failures.js';
import { presetOptions, spanNote } from '../../app/page/widgets/fault_dialog.js';
import { episodeLabel } from '../../app/page/widgets/pickers.js';

test('the steps of an intervention end before the first step after it', () => {
  assert.equal(spanProblem(30, 76, 100), '');
  assert.equal(spanProblem(0, 100, 100), '');
  assert.match(spanProblem(30, 30, 100), /has no steps/);
  assert.match(spanProblem(30, NaN, 100), /has no steps/);
  assert.match(spanProblem(30, 101, 100), /steps 0 to 99.* at most 100/);
});

test('a note names faults that end after the displayed episode', () => {
  assert.equal(spanNote('image_frozen:from=3:to=100,force_bias=2', 100), '');
  assert.match(
    spanNote('image_frozen:to=600,force_bias=2:to=50,delay=image:steps=3:to=200', 100),
    /last step of this episode is 99, so :to=600, :to=200 has no effect/,
  );
  assert.equal(spanNote('image_frozen:to=600', null), '');
});

test('faults of a preset have its name, with and without default values', () => {
  const presets = [{ name: 'image noisy', faults: 'image_noise=40', stored: 'image_noise' }];
  const expected = [['image_noise=40', 'image noisy']];
  assert.deepEqual(presetOptions(presets, ''), expected);
  assert.deepEqual(presetOptions(presets, 'image_noise=40'), expected);
  assert.deepEqual(presetOptions(presets, 'image_noise'), [['image_noise', 'image noisy']]);
  assert.deepEqual(presetOptions(presets, 'image_noise=9'), [
    ...expected,
    ['image_noise=9', 'image_noise=9'],
  ]);
});

test('the button that promotes a checkpoint names a criterion that is not met', () => {
  assert.equal(promoteText(undefined), 'Promote to default');
  assert.equal(promoteText('met'), 'Promote to default');
  assert.equal(promoteText('not met'), 'Promote to default (criterion not met)');
  assert.equal(promoteText('inconclusive'), 'Promote to default (criterion inconclusive)');
  assert.equal(promoteText('not excluded'), 'Promote to default (regression not excluded)');
});

test('a met criterion names the limit that the episodes do not exclude', () => {
  const slices = /** @type {Success['slices']} */ ([
    { slice: 'contact', limit: -0.1 },
    { slice: 'clean', limit: 0.05 },
  ]);
  const success = /** @type {Success} */ ({ slices, not_excluded: ['clean'] });
  assert.deepEqual(notExcluded(success), [slices[1]]);
  assert.deepEqual(outcomeView('met', [slices[1]]), {
    text: 'met; +5 % not excluded',
    tone: 'not excluded',
  });
  assert.deepEqual(outcomeView('met', []), { text: 'met', tone: 'met' });
  assert.deepEqual(notExcluded(/** @type {Success} */ ({ slices })), []); // an older result
});

test('slow diagnostics follow the others, before those that do not apply', () => {
  const entry = (/** @type {string} */ name, slow = false, why_not = null) => ({
    name,
    slow,
    why_not,
  });
  const entries = [entry('maps', true), entry('pf', false, 'no particles'), entry('weights')];
  assert.deepEqual(
    inOrder(entries).map(({ name }) => name),
    ['weights', 'maps', 'pf'],
  );
});

test('the status at the start of a verdict has a tone', () => {
  assert.deepEqual(verdictStatus('No alarm: within the healthy record.'), {
    status: 'No alarm',
    tone: 'good',
  });
  assert.deepEqual(verdictStatus('Alarm, NEES/n 3.'), { status: 'Alarm', tone: 'bad' });
  const unusual = verdictStatus('Unusual episode (2 % of the healthy ones), NEES/n 3.');
  assert.deepEqual(unusual, { status: 'Unusual episode', tone: 'warn' });
  assert.deepEqual(verdictStatus('NEES/n is 3.'), { status: '', tone: '' });
});

test('a failure in another episode is announced', () => {
  assert.equal(episodeNote({ episode: 9, step: 3 }, 9, '1 of 4'), '');
  assert.equal(
    episodeNote({ episode: 12, step: 3 }, 9, '2 of 4'),
    'Failure 2 of 4 is in episode 12, step 3. ctrl z returns to episode 9.',
  );
});

test('the label of an episode does not repeat the name of a task', () => {
  const episode = { index: 9, split: 'test', steps: 100, contact_fraction: 0.21, label: '' };
  const text = 'pushed · test · 100 steps · contact 21 %';
  assert.equal(episodeLabel({ ...episode, policy: 'push' }), `9 · ${text}`);
  assert.match(episodeLabel({ ...episode, policy: 'expert' }), /^9 · expert · test/);
});
