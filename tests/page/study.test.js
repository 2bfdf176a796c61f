/** The Study tab: suggested commands and colours. */

import assert from 'node:assert/strict';
import test from 'node:test';

import { studyCommands } from '../../app/page/tabs/missing_study.js';
import { colourOf } from '../../app/page/widgets/filter_colours.js';

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

test('filters of different modalities have different colours, estimators of one have the same', () => {
  const names = ['crossmodal-ekf', 'gps-ekf', 'gps-pf', 'lidar-ekf'];
  const [fused, gps, particles, lidar] = names.map((name) => colourOf(name, names));
  assert.equal(new Set([fused, gps, lidar]).size, 3);
  assert.equal(gps, particles);
});
