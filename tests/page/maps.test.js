import assert from 'node:assert/strict';
import test from 'node:test';

import { CELL_STEPS } from '../../app/page/core/constants.js';
import {
  axesText,
  colourScale,
  layerMeasures,
  mapTitle,
  pairwiseMeasures,
  positionText,
  shapeName,
  tilesScale,
  valuesAt,
} from '../../app/page/maps/map_summary.js';
import { moved, offsetAt } from '../../app/page/maps/crosshair.js';
import { csv } from '../../app/page/maps/export_map.js';
import { fitsCloseUp, mapLayout } from '../../app/page/maps/map_layout.js';
import { comparable } from '../../app/page/maps/reference_maps.js';
import {
  areaUnit,
  borders,
  cellAt,
  rangeDigits,
  rangeLabels,
  readMaps,
  shades,
  tileShade,
  tileSteps,
  valueAt,
} from '../../app/page/maps/map_values.js';
import { SvgContext } from '../../app/page/maps/svg_context.js';
import { FUSION, makeTrace } from './fixtures.js';

const HEADER = {
  type: 'maps',
  serial: 7,
  other: false,
  step: 2,
  size: 3,
  rows: 3,
  quantity: 'likelihood',
  rule: 'sum of likelihoods (unimodal)',
  angle: null,
  expected: 1.5,
  shape: ['round', 'ridge', 'ring'],
  layers: ['image', 'haptics', 'fused'],
  axes: [
    { name: 'hinge_x', index: 0, unit: 'm', display_unit: 'cm', scale: 100, half_width: 0.3 },
    { name: 'hinge_y', index: 1, unit: 'm', display_unit: 'cm', scale: 100, half_width: 0.3 },
  ],
  others: 'fixed',
  note: '',
  centre: [1, 2],
  truth: [1, 2, 0],
  estimate: [1, 2, 0],
  log_max: [0, -1, 2],
  log_range: [10, 64, 20],
  peak: [
    [0, 0],
    [0.1, -0.1],
    [0, 0],
  ],
  effector: null,
  particles: 2,
  numbers: {
    truth: [0, -1, 0],
    entropy: [1, 1, 1],
    area50: [0.001, 0.01, 0.001],
    area95: [0.01, 0.1, 0.01],
    axis: [0, Math.PI / 2, 0],
    mean: [
      [0, 0],
      [0, 0],
      [0, 0],
    ],
    elongation: [1, 3, 2],
    deviation: [null, Math.PI / 6, null],
    ring_centre: [
      [0, 0],
      [0, 0],
      [0.03, -0.01],
    ],
    ring_radius: [0.01, 0.01, 0.062],
    ring_coverage: [1, 1, 0.9],
    divergence: [
      [0, 1.25],
      [20, 0],
    ],
    overlap: [
      [1, 0.5],
      [0.5, 1],
    ],
  },
};

/**
 * Maps as the server encodes them: the middle cell of each layer is the peak, all others are at the lowest value.
 * @param {object} [changes] of the header
 */
function encodedMaps(changes = {}) {
  const header = { ...HEADER, ...changes };
  const text = new TextEncoder().encode(JSON.stringify(header));
  const start = 4 + Math.ceil(text.length / 4) * 4;
  const { particles, layers, size, rows } = header;
  const count = size * rows;
  const floats = 2 * particles + layers.length * particles;
  const buffer = new ArrayBuffer(start + 4 * floats + 2 * layers.length * count);
  new DataView(buffer).setUint32(0, text.length, true);
  new Uint8Array(buffer).set(text, 4);
  new Float32Array(buffer, start, floats).set([1, 2, 1.1, 2.1, 0.25, 0.75, 0.5, 0.5, 1, 0]);
  const cells = new Uint16Array(buffer, start + 4 * floats);
  layers.forEach((_, layer) => (cells[count * layer + (count - 1) / 2] = CELL_STEPS));
  return buffer;
}

const maps = readMaps(encodedMaps());

test('maps are decoded', () => {
  assert.equal(maps.serial, 7);
  assert.equal(maps.positions.length, 4);
  assert.deepEqual([...maps.weights[0]], [0.25, 0.75]);
  assert.deepEqual([...maps.cells[2]], [0, 0, 0, 0, CELL_STEPS, 0, 0, 0, 0]);
});

test('a map over one component is a curve with lengths instead of areas', () => {
  const axes = [
    { name: 'level', index: 0, unit: 'K', display_unit: 'mK', scale: 1000, half_width: 2 },
  ];
  const layers = ['image', 'haptics', 'fused'];
  const curve = readMaps(
    encodedMaps({ axes, rows: 1, centre: [5], peak: layers.map(() => [0, 0]) }),
  );
  assert.deepEqual([...curve.cells[0]], [0, CELL_STEPS, 0]);
  assert.deepEqual(areaUnit(axes), { unit: 'mK', scale: 1000 });
  assert.equal(cellAt(curve, [1.9]), 2);
  assert.equal(positionText(curve, curve.peak[0], true), '5000.0 mK');
});

test('colours span each layer or all layers', () => {
  const [image] = shades(maps, 'normalised', 'own', null);
  assert.deepEqual([image.low, image.high, image.values[4]], [0, 1, 1]);
  const log = shades(maps, 'log', 'own', null);
  assert.deepEqual(
    log.map(({ low, high, clipped }) => [low, high, clipped]),
    [
      [-10, 0, false],
      [-41, -1, true],
      [-18, 2, false],
    ],
  );
  for (const { low, high } of shades(maps, 'log', 'same', null))
    assert.deepEqual([low, high], [-38, 2]);
});

test('the ratio of maps to themselves is zero', () => {
  for (const { values, low, high } of shades(maps, 'log', 'own', maps)) {
    assert.ok(values.every((v) => Math.abs(v) < 1e-5));
    assert.equal(low, -high);
  }
});

test('labels of colour bars', () => {
  const values = new Float32Array();
  assert.deepEqual(rangeLabels({ values, low: 0, high: 1, clipped: false }, 1), ['0', '1']);
  assert.deepEqual(rangeLabels({ values, low: -40, high: 0, clipped: true }, 0), ['≤−40', '0']);
  assert.deepEqual(rangeLabels({ values, low: -12, high: 12, clipped: true }, 0), ['≤−12', '≥+12']);
  assert.deepEqual(
    [0.1, 1, 5, 50].map((high) => rangeDigits({ values, low: 0, high, clipped: false })),
    [3, 2, 1, 0],
  );
});

test('the colour bar names its quantity, its unit, and scales that differ', () => {
  /** @param {'normalised' | 'log'} scale @param {'own' | 'same'} range @param {string} name of the reference */
  const labels = (scale, range, name = '') => {
    const layers = shades(maps, scale, range, name ? maps : null).map((shade, i) => ({
      name: maps.layers[i],
      shade,
      peak: maps.log_max[i],
    }));
    return colourScale(maps.quantity, scale, range, layers, name);
  };
  assert.deepEqual(labels('normalised', 'own'), {
    low: '0',
    high: '1',
    label: 'of each peak',
  });
  assert.equal(labels('normalised', 'same').label, 'of the highest peak');
  assert.deepEqual(labels('log', 'same'), {
    low: '≤−38',
    high: '2',
    label: 'log likelihood, nats',
  });
  assert.deepEqual(labels('log', 'own'), {
    low: '',
    high: '0',
    label: 'log likelihood below each peak, nats; ends: image −10, haptics ≤−40, fused −20',
  });
  assert.equal(labels('log', 'own', 'step 3').label, 'log density ratio to step 3, nats');
  assert.equal(axesText(maps, false), '→ Δ hinge x  ↑ Δ hinge y (cm)');
  const curve = /** @type {any} */ ({ axes: maps.axes.slice(0, 1) });
  const height = labels('normalised', 'own').label;
  assert.equal(axesText(curve, true, height), '→ hinge x (cm)  ↑ fraction of each peak');
  const log = labels('log', 'own').label;
  assert.equal(
    axesText(curve, true, log),
    '→ hinge x (cm)  ↑ log likelihood below each peak, nats',
  );
});

test('small maps show the change to contact and the steps around the cursor', () => {
  const contact = Array.from({ length: 100 }, (_, t) => t > 11 && t < 33);
  const steps = (/** @type {number} */ step) => tileSteps(contact, step).map((tile) => tile.step);
  assert.deepEqual(steps(27), [11, 12, 15, 20, 27, 30, 35, 40]);
  assert.deepEqual(steps(0), [11, 12, 0, 5, 10, 15, 20, 25]);
  assert.deepEqual(steps(99), [11, 12, 70, 75, 80, 85, 90, 99]);
  assert.deepEqual(tileSteps(contact, 27)[1], { step: 12, phase: 'contact', pair: true });
  const short = tileSteps([0, 0, 0], 1);
  assert.deepEqual(
    short.map((tile) => tile.step),
    [0, 1, 2],
  );
  assert.equal(short[0].phase, '', 'nothing is known about contact');
  const { values, low, high } = tileShade(maps, 2, 'normalised', 'own');
  assert.deepEqual([values[4], low, high], [1, 0, 1]);
  assert.ok(Math.abs(values[0] - Math.exp(-20)) < 1e-6);
  assert.deepEqual(
    [tileShade(maps, 2, 'log', 'own').values[0], tileShade(maps, 2, 'log', 'own').low],
    [-20, -40],
  );
  assert.deepEqual(
    [0, 1, 2].map((i) => tileShade(maps, i, 'log', 'same').values[4]),
    [-2, -3, 0],
  );
  assert.deepEqual(tilesScale('likelihood', 'log', 'same', tileShade(maps, 0, 'log', 'same')), {
    low: '≤−40',
    high: '0',
    label: "log likelihood below the step's highest peak, nats",
  });
});

test('maps are as large as their panel allows, in two rows where that is larger', () => {
  assert.deepEqual(mapLayout(3, 640, 200, 18), { columns: 3, side: 164 }); // the height limits them
  assert.equal(mapLayout(3, 460, 400, 18).columns, 3);
  assert.equal(mapLayout(6, 600, 500, 18).columns, 3);
  assert.equal(mapLayout(6, 1600, 200, 18).columns, 6);
  assert.equal(mapLayout(2, 10, 10, 18).side, 60);
  const { columns, side } = mapLayout(8, 500, 170, 18);
  assert.ok(columns < 8 && side >= 52); // scrolled
  assert.equal(mapLayout(7, 570, 120, 28).columns, 7); // the last one, the fused map, is in view
});

test('the close-up contains peaks and regions', () => {
  const numbers = { ...maps.numbers, area95: [0.001, 0.001, 0.001], elongation: [1, 1, null] };
  const peaks = maps.peak.map(() => [0, 0.02]);
  assert.ok(fitsCloseUp({ ...maps, numbers, peak: peaks }));
  assert.ok(!fitsCloseUp({ ...maps, numbers, peak: [...peaks.slice(1), [0.07, 0]] }));
  assert.ok(
    !fitsCloseUp({ ...maps, numbers: { ...numbers, elongation: [40, 1, 1] }, peak: peaks }),
  );
});

test('the crosshair stays on the visible area', () => {
  assert.deepEqual(offsetAt(maps, 4, 0.5, 0.5), [0, 0]);
  assert.deepEqual(offsetAt(maps, 2, 1, 1), [0.15, -0.15]);
  assert.equal(offsetAt(maps, 1, 1.01, 0.5), null);
  const close = (/** @type {number[]} */ a, /** @type {number[]} */ b) =>
    assert.ok(
      a.every((value, i) => Math.abs(value - b[i]) < 1e-12),
      `${a} ${b}`,
    );
  close(moved(maps, 1, null, [1, 0], 1), [0.2, 0]);
  close(moved(maps, 1, [0.2, 0], [1, 0], 5), [0.2, 0]);
  close(moved(maps, 1, [0, 0], [0, -1], 1), [0, -0.2]);
});

test('maps are compared with maps of the same layers, content and extent', () => {
  assert.ok(comparable(maps, { ...maps }));
  const [x, y] = maps.axes;
  const others = [
    { layers: ['image'] },
    { quantity: /** @type {const} */ ('posterior') },
    { others: /** @type {const} */ ('marginal') },
    { axes: [x, { ...y, half_width: 0.2 }] },
    { axes: [y, x] },
  ];
  for (const other of others)
    assert.ok(!comparable(maps, { ...maps, ...other }), Object.keys(other)[0]);
});

test('values of cells', () => {
  assert.equal(cellAt(maps, [0, 0]), 4);
  assert.equal(cellAt(maps, [-0.29, 0.29]), 6);
  assert.equal(cellAt(maps, [9, 9]), 8);
  assert.deepEqual(valueAt(maps, 0, 4), { log: 0, relative: 1, clipped: false });
  assert.equal(valueAt(maps, 1, 0).clipped, true);
  assert.deepEqual(valuesAt(maps, 0, [0, 0], null), ['1.000 of peak', 'ln 0.00']);
  assert.equal(valuesAt(maps, 1, [0.2, 0.2], new Float32Array(9))[2], 'change 0.00 nats');
});

test('the border of a peak is a closed contour around it', () => {
  const [segments] = borders(maps, 0, [0.5]);
  assert.equal(segments.length, 4 * 4);
  for (let i = 0; i < segments.length; i += 2)
    assert.ok(Math.hypot(segments[i] - 0.5, segments[i + 1] - 0.5) < 0.34);
});

test('measures as text', () => {
  assert.deepEqual(layerMeasures(maps, 1, false).cells, [
    '+10.0, −10.0 cm',
    '100',
    '1000',
    '10.21',
    'ridge 90°, 3.0:1, 30° off expected',
  ]);
  assert.equal(layerMeasures(maps, 1, true).cells[0], '110.0, 190.0 cm');
  assert.deepEqual(
    [0, 1, 2].map((layer) => shapeName(maps, layer)),
    [['round'], ['ridge 90°', '3.0:1'], ['ring', 'radius 6.2 cm']],
  );
  const { description } = layerMeasures(maps, 2, false);
  assert.match(description, /around \+3\.0, −1\.0 cm from the truth, over 90 % of the circle/);
  const flat = layerMeasures({ ...maps, shape: ['flat', 'flat', 'flat'] }, 1, false);
  assert.equal(flat.cells[4], 'flat');
  assert.match(flat.description, /; flat: the likelihood hardly varies over the map$/);
  const noDirection = { ...maps, numbers: { ...maps.numbers, deviation: [null, null, null] } };
  assert.equal(layerMeasures(noDirection, 1, false).cells[4], 'ridge 90°, 3.0:1');
  assert.equal(mapTitle(maps), 'Likelihood. Fused: sum of likelihoods (unimodal)');
  assert.equal(
    mapTitle({ ...maps, quantity: 'posterior', layers: ['image', 'fused'] }),
    'Posterior',
  );
  assert.equal(
    pairwiseMeasures(maps),
    'KL(image‖haptics) 1.3, KL(haptics‖image) 20 nats, overlap 50 %',
  );
});

test('the measures of a posterior whose estimate is off the map', () => {
  const far = { ...maps, quantity: 'posterior', estimate: [0.5, 2.05, 0] };
  assert.deepEqual(shapeName(far, 2), ['estimate off the map']);
  assert.equal(
    layerMeasures(far, 2, false).cells.at(-1),
    'estimate off the map, at −50.0, +5.0 cm',
  );
  assert.equal(layerMeasures(far, 2, false).cells[0], '–');
  assert.equal(shapeName({ ...far, quantity: 'likelihood' }, 2)[0].slice(0, 4), 'ring');
  assert.equal(shapeName({ ...far, estimate: [1.2, 2, 0] }, 2)[0].slice(0, 4), 'ring');
});

test('SVG drawing', () => {
  const context = new SvgContext();
  context.save();
  context.translate(1, 2);
  context.strokeStyle = 'rgb(0 0 0 / 0.3)';
  context.beginPath();
  context.moveTo(0, 0);
  context.lineTo(1.234, 5);
  context.stroke();
  context.fillText('a < b', 0, 0);
  context.fillText('−2000', 0, 0, 12);
  context.restore();
  const svg = context.document(10, 20);
  assert.match(svg, /^<svg [^>]*viewBox="0 0 10 20">/);
  assert.match(svg, /d="M0 0L1\.23 5" fill="none" stroke="rgb\(0,0,0\)" stroke-opacity="0\.3"/);
  assert.match(svg, /"[^>]*font[^>]*">a &#60; b</);
  assert.match(svg, /textLength="12" lengthAdjust="spacingAndGlyphs">−2000</);
  assert.equal(svg.split('<g').length, svg.split('</g').length);
});

test('a table of several steps names their times where the data have timestamps', () => {
  const later = readMaps(encodedMaps({ step: 3 }));
  /** @param {import('../../app/page/data/trace.js').Trace} trace */
  const lines = (trace) =>
    csv(
      [maps, later].map((sheet) => ({
        ...{ trace, title: '', options: /** @type {any} */ ({}) },
        maps: sheet,
        layers: [/** @type {any} */ ({ name: 'fused', index: 2 })],
      })),
    ).split('\n');
  const time = { shape: [4], values: [0, 0.25, 0.5, 1.5] };
  const timed = lines(makeTrace({ ...FUSION, time }, { steps: 4 }));
  assert.match(timed[0], /steps 2 \(0\.50 s\), 3 \(1\.50 s\)/);
  assert.match(timed[2], /^step,time_s,hinge_x_offset_cm,/);
  assert.match(timed[3], /^2,0\.5000,-/);
  assert.match(timed[12], /^3,1\.5000,-/);
  const plain = lines(makeTrace(FUSION));
  assert.match(plain[0], /steps 2, 3/);
  assert.match(plain[2], /^step,hinge_x_offset_cm,/);
  assert.match(plain[3], /^2,-/);
});
