/** Suggested commands of the Study tab. */

import assert from 'node:assert/strict';
import test from 'node:test';

import { studyCommands } from '../../app/page/tabs/missing_study.js';

test('a study is suggested with the filters of its modalities', () => {
  const filters = (modalities) =>
    studyCommands('t', modalities, true)
      .join()
      .match(/(?<=--filter )[\w-]+/g);
  assert.deepEqual(filters(['image', 'haptics']), ['crossmodal-ekf', 'image-ekf', 'haptics-ekf']);
  assert.deepEqual(filters(['lidar', 'gps']), ['crossmodal-ekf']);
  const lines = studyCommands('t', ['image'], true);
  assert.ok(lines[0].endsWith('-o t.h5') && lines[1].includes('--data t=t.h5'));
  assert.ok(studyCommands('t', [], false)[0].startsWith('beliefscope study'), 'recorded data');
});
