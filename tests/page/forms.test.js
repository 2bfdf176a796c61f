import assert from 'node:assert/strict';
import test from 'node:test';

import { spanProblem } from '../../app/page/tabs/comparison_form.js';
import { promoteText } from '../../app/page/tabs/finetune_run.js';
import { spanNote } from '../../app/page/widgets/fault_dialog.js';

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

test('the button that promotes a checkpoint names a criterion that is not met', () => {
  assert.equal(promoteText(undefined), 'Promote to default');
  assert.equal(promoteText('met'), 'Promote to default');
  assert.equal(promoteText('not met'), 'Promote to default (criterion not met)');
  assert.equal(promoteText('inconclusive'), 'Promote to default (criterion inconclusive)');
});
