/** Columns of the table of failure events. */

import assert from 'node:assert/strict';
import test from 'node:test';

import { eventColumns } from '../../app/page/tabs/event_table.js';

const SCORE = { name: 'error', title: 'position error', display_unit: 'cm', scale: 100 };
const FAILURES = { layers: ['image', 'haptics', 'fused'], scores: [SCORE] };

test('updates that the filter does not report have no column', () => {
  const titles = (/** @type {(number | null)[]} */ error) => {
    const event = { episode: 3, step: 8, error, nees: 1.5, effective_weights: null };
    const columns = eventColumns(
      /** @type {any} */ (FAILURES),
      /** @type {any} */ (SCORE),
      /** @type {any} */ ([event]),
    );
    return columns.map(({ title }) => title);
  };
  const [first, last] = [['episode', 'step', 'position error cm', 'phase'], ['NEES/n']];
  assert.deepEqual(titles([null, null, 0.1]), [...first, ...last]);
  const update = 'haptics-only update cm';
  assert.deepEqual(titles([null, 0.2, 0.1]), [...first, update, ...last]);
});
