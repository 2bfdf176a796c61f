import assert from 'node:assert/strict';
import { test } from 'node:test';

import { matching } from '../../app/page/tabs/experiment_filter.js';
import { numbersOf } from '../../app/page/tabs/experiment_rows.js';
import { RECORDED, ROW } from './fixtures.js';

const ROWS = [ROW, { ...ROW, name: 'run-2', faults: '', nees: null, error: 0.7 }];
/** @param {string} text */
const names = (text) => matching(ROWS, text).rows.map(({ name }) => name);

test('words match in any text, conditions match numbers, and more of them never match more', () => {
  assert.deepEqual(names(''), ['run-1', 'run-2']);
  assert.deepEqual(names('EKF door'), ['run-1', 'run-2']);
  assert.deepEqual(names('blackout'), ['run-1']);
  assert.deepEqual(names('0.001'), ['run-1', 'run-2']);
  assert.deepEqual(names('nees>2'), ['run-1'], 'a missing value meets no condition');
  assert.deepEqual(names('error>=0.7'), ['run-2']);
  assert.deepEqual(names('error<0.7 nees>2.5'), []);
  for (const key of Object.keys(numbersOf(ROWS))) assert.equal(names(`${key}<-1e9`).length, 0);
});

test('columns that contain an unknown name are listed first', () => {
  const rows = [{ ...ROW, provenance: '{"optimizer": {"lr": 1}, "a": 2}' }];
  assert.match(matching(rows, 'lr > 1').problem, /no column lr\. Columns: optimizer\.lr, error, /);
});

test('clean data are named as in the table', () => {
  for (const text of ['faults = none', 'faults=""', 'none run', 'faults != blackout=0.4'])
    assert.deepEqual(names(text), ['run-2'], text);
  assert.deepEqual(names('faults != none'), ['run-1']);
});

/** Indices of the matching rows. @param {string} text */
const places = (text) => {
  const { rows, problem } = matching(RECORDED, text);
  assert.equal(problem, '', text);
  return rows.map(({ name }) => Number(name.at(-1))).join('');
};

test('conditions have spaces, single equals signs, titles, units, quotes and numbers as text', () => {
  for (const text of ['seed=1', 'seed == 1', 'SEED = 1.0', 'lr=3e-4', 'lr < 5E-4', '"seed"="1"'])
    assert.equal(places(text), '1', text);
  for (const text of ['"RMSE, cm">4', 'error ≥4.5']) assert.equal(places(text), '2', text);
  assert.equal(places('NEES>2 Nees/N<3 "95 % coverage" <= 90%'), '012');
  assert.equal(places('coverage95<90%'), '');
  assert.equal(places('lr>0'), '01', 'numbers stored as text are numbers, other texts none');
  assert.equal(places('lr=auto'), '2');
  assert.equal(places('lr!=0.001'), '12');
  assert.equal(places('debug=TRUE'), '0');
  assert.equal(places('note!=y'), '0', 'a missing value meets no condition');
  assert.equal(places('"model.weird key"="A b"'), '0');
  assert.equal(places('operator=m\u00fcller'), '12', 'in any Unicode form');
  assert.equal(places('M\u00dcLLER seed>1'), '2');
  assert.equal(places('"a b" s\u00f8'), '0');
  assert.equal(places('checkpoint=run-2'), '2');
  assert.equal(places('faults = blackout=0.4'), '012');
  assert.equal(places('blackout=0.4'), '012', 'a fault is a word');
  assert.equal(places('RMSE=own'), '2', 'an entry precedes a title');
});

test('what is wrong with a condition is reported, and no row matches', () => {
  const problem = (/** @type {string} */ text) => {
    const result = matching(RECORDED, text);
    assert.equal(result.rows.length, 0);
    return result.problem;
  };
  assert.match(
    problem('run neez > 2 nees>1'),
    /^“neez > 2”: there is no column neez\. Columns: error, .*nees, .* and \d+ more\. Quote names with spaces\.$/,
  );
  assert.equal(problem('nees>two'), '“nees>two”: two is not a number; compare texts with = or !=.');
  assert.equal(problem('nees >'), '“nees >”: the value after > is missing.');
  assert.match(problem('>2'), /^“>2”: the column before > is missing/);
  assert.equal(problem('run "a b'), '“"a b”: the closing quotation mark is missing.');
  assert.match(problem('blackout=0.7'), /there is no column blackout/);
  assert.match(problem('a>1 b<2'), /“a>1”.*“b<2”/);
});

test('an unfinished condition is a word, and does not fail', () => {
  assert.deepEqual(names('nees>'), []);
  assert.deepEqual(names('('), []);
});
