import assert from 'node:assert/strict';
import test from 'node:test';

import {
  displayName,
  fixed,
  formatBytes,
  mainName,
  percent,
  probabilityText,
  sentence,
  signed,
  significant,
  wrapDegrees,
  typeset,
} from '../../app/page/core/units.js';

test('fixed uses a true minus sign and a dash for missing values', () => {
  assert.equal(fixed(1.25, 2), '1.25');
  assert.equal(fixed(-1.25, 2), '−1.25');
  assert.equal(fixed(-0.01), '0.0');
  assert.equal(fixed(9999999.9), '9999999.9');
  assert.equal(fixed(-1.1366969e22, 2), '−1.14e22');
  for (const value of [null, undefined, NaN, Infinity]) assert.equal(fixed(value), '–');
});

test('no probability is certain', () => {
  assert.equal(probabilityText(0.994), '0.99');
  assert.equal(probabilityText(0.9951), 'above 0.99');
});

test('signed adds a plus only to values that round to a positive number', () => {
  assert.equal(signed(0.5), '+0.5');
  assert.equal(signed(0.01), '0.0');
  assert.equal(signed(-0.5), '−0.5');
});

test('significant keeps three digits', () => {
  assert.equal(significant(123.45), '123');
  assert.equal(significant(0.012345), '0.0123');
  assert.equal(significant(42), '42');
  assert.equal(significant(0.0000123), '1.23e−5');
  assert.equal(significant(2e7), '2.00e7');
  assert.equal(significant(null), '–');
});

test('percentages, sizes, angles and names', () => {
  assert.equal(percent(0.416), '42 %');
  assert.equal(percent(undefined), '–');
  assert.deepEqual([512, 2.5e6, 3e9].map(formatBytes), ['512 B', '2.5 MB', '3.0 GB']);
  assert.deepEqual([190, -190, 10].map(wrapDegrees), [-170, 170, 10]);
  assert.equal(displayName('hinge_x'), 'hinge x');
  assert.equal(sentence('no maps'), 'No maps.');
  assert.equal(sentence('Really?'), 'Really?');
  assert.equal(sentence('Loading …'), 'Loading …');
  assert.equal(sentence('hinge_x is missing'), 'hinge_x is missing.');
  assert.equal(sentence('door.h5 has no episodes.'), 'door.h5 has no episodes.');
  assert.equal(sentence('nothing. at all'), 'Nothing. at all.');
  assert.equal(sentence(''), '');
});

test('numbers in texts of the server are set', () => {
  assert.equal(typeset('angle 1.67 -> 1.95 deg'), 'angle 1.67 → 1.95°');
  assert.equal(typeset('angle error (deg)'), 'angle error (°)');
  assert.equal(typeset('-0.3 (-.5 to 2)'), '−0.3 (−.5 to 2)');
  for (const text of [
    'steps 3-5',
    'image-only',
    '2026-11-25',
    '1e-05',
    'force_bias:x=-3',
    '--seed',
  ])
    assert.equal(typeset(text), text);
});

test('a position belongs to the object of its first axis, or to none', () => {
  const subject = (/** @type {string} */ name, main = 'position') =>
    mainName(/** @type {any} */ ({ main: { name: main }, map: { components: [name] } }));
  assert.deepEqual(
    ['hinge_x', 'x', 'east'].map((name) => subject(name)),
    ['hinge', 'position', 'position'],
  );
  assert.equal(subject('rotor', 'rotor'), 'rotor');
});
