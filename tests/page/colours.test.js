import assert from 'node:assert/strict';
import test from 'node:test';

import {
  COLOUR_TABLES,
  assignSpareColours,
  cssVariable,
  gradient,
  scaled,
  translucent,
} from '../../app/page/core/colours.js';

test('colour tables start and end at the ends of their colour map', () => {
  const { viridis } = COLOUR_TABLES;
  assert.equal(viridis.length, 256);
  assert.deepEqual([...new Uint8Array(viridis.buffer, 0, 4)], [0x44, 0x01, 0x54, 255]);
  assert.deepEqual([...new Uint8Array(viridis.buffer, 4 * 255, 4)], [0xfd, 0xe7, 0x25, 255]);
  assert.match(gradient('diverging'), /^linear-gradient\(90deg, #053061, .*#67001f\)$/);
});

test('unknown modalities get spare colours', () => {
  assignSpareColours(['image', 'sound', 'touch']);
  assert.equal(cssVariable('image'), '--image');
  assert.equal(cssVariable('sound'), '--spare-0');
  assert.equal(cssVariable('touch'), '--spare-1');
  assignSpareColours(['haptics', 'camera', 'sound']);
  assert.equal(cssVariable('camera'), '--image');
  assert.equal(cssVariable('sound'), '--spare-0');
});

test('other functions', () => {
  assert.equal(scaled(12.4), 12);
  assert.equal(translucent('red', 0.2), 'color-mix(in srgb, red 20%, transparent)');
});
