import assert from 'node:assert/strict';
import { test } from 'node:test';

import { columnsOf, entryColumns, tableLayout } from '../../app/page/tabs/experiment_columns.js';

const ROWS = [0.001, 0.01].map(
  (lr, i) =>
    /** @type {any} */ ({
      name: `run-${i}`,
      filter: 'crossmodal-ekf',
      unit: 'cm',
      components: {},
      training: '{}',
      checkpoint: String(i).repeat(64),
      provenance: JSON.stringify({ lr, width: 32 * i }),
    }),
);
const STATE = { rows: 'checkpoints', groups: '', pinned: '' };

test('columns are computed once for each change of rows, pins and grouping', () => {
  const layout = tableLayout();
  const first = layout(ROWS, STATE);
  const keys = first.columns.map(({ key }) => key);
  assert.deepEqual(
    keys,
    columnsOf(ROWS, false, entryColumns(ROWS, []).entries, []).map(({ key }) => key),
  );
  assert.equal(layout(ROWS, { ...STATE }), first, 'such as for each key pressed in the filter');
  assert.notEqual(layout([...ROWS], STATE), first);
  const last = layout(ROWS, STATE);
  for (const change of [{ pinned: 'lr' }, { rows: 'seeds' }, { groups: 'lr' }]) {
    assert.notEqual(layout(ROWS, { ...STATE, ...change }), last);
  }
  assert.equal(layout(ROWS, { ...STATE, pinned: 'lr' }).columns[1].key, 'lr');
});
