import assert from 'node:assert/strict';
import test from 'node:test';

import { parsePermalink, permalink } from '../../app/page/core/state.js';
import { describeOpened, openRecordings, reportedRun } from '../../app/page/tabs/recorded_run.js';
import { CATALOG } from './fixtures.js';

/** @typedef {import('../../app/page/types/server.js').RecordingEntry} RecordingEntry */

const { state } = parsePermalink('?task=door&episode=9&step=7', CATALOG);
const FILE = /** @type {RecordingEntry} */ ({
  name: 'a.rrd',
  task: 'push',
  filter: 'image-ekf',
  episode: 3,
  faults: 'blackout=0.4',
  application: 'beliefscope',
  run: { filter: 'image-ekf', data: 'sample' },
});
const ELSEWHERE = { ...FILE, name: 'b.rrd', run: null };

test('a recording opens with its run, if this server has it', () => {
  const patch = openRecordings(CATALOG, state, [FILE]);
  const { task, filter, data, episode, faults, step, tab, recording } = patch;
  assert.deepEqual(
    [task, filter, data, episode, faults, step, tab, recording],
    ['push', 'image-ekf', 'sample', 3, 'blackout=0.4', 0, 'rerun', 'a.rrd'],
  );
  const rest = { tab: 'rerun', playing: false };
  assert.deepEqual(openRecordings(CATALOG, { ...state, ...patch }, [FILE]), {
    recording: 'a.rrd',
    ...rest,
  });
  assert.deepEqual(openRecordings(CATALOG, state, [ELSEWHERE]), { recording: 'b.rrd', ...rest });
  assert.deepEqual(openRecordings(CATALOG, state, [FILE, ELSEWHERE]), {
    recording: 'a.rrd/b.rrd',
    ...rest,
  });
});

test('the link contains the open recordings', () => {
  const search = permalink({ ...state, recording: 'a, b=1.rrd/c.rrd' });
  assert.equal(parsePermalink(search, CATALOG).state.recording, 'a, b=1.rrd/c.rrd');
});

test('the bar names the run of the page where the recording has another one', () => {
  assert.equal(describeOpened([FILE], true, state), 'a.rrd: the run of this page');
  const rest = 'The rest of the page shows door · crossmodal-pf · episode 9; its time is separate.';
  assert.equal(
    describeOpened([ELSEWHERE], false, state),
    `b.rrd is another run (push · image-ekf · episode 3). ${rest}`,
  );
  assert.equal(describeOpened([FILE, ELSEWHERE], false, state), `a.rrd and b.rrd. ${rest}`);
  const foreign = { ...ELSEWHERE, task: null, filter: null, episode: null, application: 'other' };
  assert.equal(describeOpened([foreign], false, state), `b.rrd is another run (other). ${rest}`);
});

test('the run of a report is over the data with its episode', () => {
  const report = /** @type {any} */ ({
    task: 'door',
    filter: 'crossmodal-pf',
    episode: 9,
    faults: '',
  });
  const dataOf = (/** @type {object} */ changes) =>
    reportedRun(CATALOG, { ...report, ...changes }).run?.data;
  assert.equal(dataOf({ data_hash: 'ab', data: 'live:mon' }), 'live:mon');
  assert.equal(dataOf({ data_hash: 'ab', data: null }), undefined);
  assert.equal(dataOf({ data_hash: '', data: null }), 'door');
  const { problem } = reportedRun(CATALOG, { ...report, data_hash: 'ab', data: null });
  assert.equal(problem, 'No data set of this server has the episode 9.');
});
