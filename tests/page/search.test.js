import assert from 'node:assert/strict';
import { test } from 'node:test';

import { rating, search } from '../../app/page/core/search.js';

const TITLES = [
  'Diagnosis Tab',
  'Diagnostics Tab',
  'crossmodal-ekf Filter',
  'crossmodal-pf Filter',
  'unimodal-ekf Filter',
  '40 % image blackout Faults',
  'image frozen Faults',
];
/** @param {string} query */
const searchTitles = (query) => search(query, TITLES, (title) => title);

test('an empty query matches all in their order', () => {
  assert.deepEqual(searchTitles(''), TITLES);
  assert.deepEqual(searchTitles('  '), TITLES);
});

test('the order of words and their case do not matter, and more words never match more', () => {
  assert.deepEqual(searchTitles('FILTER ekf'), searchTitles('ekf filter'));
  for (const query of ['ekf', 'image', 'diag', 'fault'])
    for (const more of ['filter', 'fro', 'x']) {
      const narrower = searchTitles(`${query} ${more}`);
      assert.ok(narrower.every((title) => searchTitles(query).includes(title)));
    }
});

test('starts of the text come before starts of words, and those before other places', () => {
  assert.deepEqual(searchTitles('image'), ['image frozen Faults', '40 % image blackout Faults']);
  assert.ok((rating('modal', 'modal x') ?? 0) > (rating('modal', 'x modal') ?? 0));
  assert.ok((rating('modal', 'x modal') ?? 0) > (rating('modal', 'unimodal') ?? 0));
  assert.equal(rating('modal pf', 'unimodal-ekf'), null);
  assert.equal(rating('(', 'a (b)'), 2, 'no pattern');
});
