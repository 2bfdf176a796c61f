import assert from 'node:assert/strict';
import { test } from 'node:test';

import {
  cellOf,
  faultKinds,
  faultLevel,
  repeatsSeed,
  seedGroups,
} from '../../app/page/tabs/experiment_groups.js';
import { columnsOf, entryColumns } from '../../app/page/tabs/experiment_columns.js';
import { tableCsv } from '../../app/page/tabs/experiment_csv.js';
import { worstOfSeed } from '../../app/page/tabs/experiment_episodes.js';
import { matching } from '../../app/page/tabs/experiment_filter.js';
import { groupEntries, namesText } from '../../app/page/tabs/experiment_group_menu.js';
import {
  differingEntries,
  isNumeric,
  provenanceOf,
  settingEntries,
} from '../../app/page/tabs/experiment_provenance.js';
import {
  comparedWith,
  numberOf,
  numbersOf,
  parseSort,
  rowKey,
  sortText,
  sortValue,
  unknownChoice,
  whyNotCompared,
} from '../../app/page/tabs/experiment_rows.js';
import { niceStep } from '../../app/page/core/units.js';
import { scale } from '../../app/page/tabs/scatter.js';
import { RECORDED, ROW } from './fixtures.js';

const ROWS = [ROW, { ...ROW, name: 'run-2', faults: '', nees: null, error: 0.7 }];
test('columns with numbers as text are sorted and drawn as numbers', () => {
  const rows = [{ n: '1e1' }, { n: 9 }, {}].map((provenance, i) => ({
    ...ROW,
    checkpoint: String(i).repeat(64),
    provenance: JSON.stringify(provenance),
  }));
  assert.ok(isNumeric(rows, 'n'));
  assert.ok(!isNumeric(RECORDED, 'lr'));
  assert.deepEqual(
    rows.map((row) => numberOf(row, 'n')),
    [10, 9, null],
  );
  assert.deepEqual(
    RECORDED.map((row) => sortValue(row, 'lr', false)),
    ['1e-3', '0.0003', 'auto'],
  );
});

test('a choice that does not exist is named with the available ones', () => {
  assert.equal(unknownChoice('Sweep', 'b', ['', 'a', 'b'], 'a'), '');
  assert.equal(
    unknownChoice('Sweep', 'c', ['', 'a', 'b', 'a'], 'a is displayed'),
    'Sweep “c” does not exist here: a is displayed. Available: a, b.',
  );
  const many = Array.from({ length: 40 }, (_, i) => `p${i}`);
  assert.match(unknownChoice('Quantity', 'c', many, 'e'), /p7 and 32 more\.$/);
});

const TRAINED = [
  { lr: 0.001, model: { width: 32 }, run: 'https://tracker/1', same: [1], debug: true },
  { lr: 0.01, model: { width: 64 }, run: 'https://tracker/2', same: [1] },
].map((provenance, i) => ({
  ...ROW,
  name: `run-${i}`,
  checkpoint: String(i).repeat(64),
  provenance: JSON.stringify(provenance),
}));

test('entries of the provenance that differ are columns, which conditions compare', () => {
  assert.deepEqual(differingEntries(TRAINED), ['lr', 'model.width', 'run', 'debug']);
  const columns = columnsOf(TRAINED, false, differingEntries(TRAINED), []);
  const texts = (/** @type {string} */ key) =>
    TRAINED.map((row) => columns.find((column) => column.key === key)?.content(row));
  assert.deepEqual(texts('model.width'), ['32', '64']);
  assert.deepEqual(texts('debug'), ['true', '–']);
  const number = (/** @type {string} */ key) => columns.find((c) => c.key === key)?.number;
  assert.deepEqual(['lr', 'run', 'debug'].map(number), [true, false, false]);
  const matched = (/** @type {string} */ text) =>
    matching(TRAINED, text).rows.map(({ name }) => name);
  assert.deepEqual(matched('lr<5e-3'), ['run-0']);
  assert.deepEqual(matched('model.width>=32 tracker/2'), ['run-1']);
});

test('an entry named like a column does not replace its values', () => {
  const rows = TRAINED.map((row, i) => ({ ...row, provenance: JSON.stringify({ error: i + 7 }) }));
  assert.deepEqual(differingEntries(rows), ['provenance.error']);
  assert.equal(matching(rows, 'provenance.error>7').rows.length, 1);
  assert.equal(matching(rows, 'error<7').rows.length, 2);
});

test('entries of a group are those of its members', () => {
  const rows = rowsOf({ provenance: '{"spread": 2}' }, { provenance: '{"spread": 2}' });
  const [group] = seedGroups(rows, ['spread']);
  assert.equal(group.members.length, 2);
  assert.deepEqual(provenanceOf(group), provenanceOf(rows[0]));
});

test('the level of a fault is not its first step', () => {
  const rows = ['force_bias=5:from=20', 'drop=haptics:from=50', 'blackout=0.4'];
  assert.deepEqual(faultKinds(rows.map((faults) => ({ ...ROW, faults }))), [
    'force_bias:from=20',
    'blackout',
  ]);
  assert.equal(faultLevel({ ...ROW, faults: rows[0] }, 'force_bias:from=20'), 5);
});

test('pinned columns are the first, in the order of pinning, and no column is lost', () => {
  const keys = (/** @type {string[]} */ ...pinned) =>
    columnsOf(TRAINED, false, differingEntries(TRAINED), pinned).map(({ key }) => key);
  assert.deepEqual(keys('lr', 'nees').slice(0, 4), ['name', 'lr', 'nees', 'error']);
  assert.deepEqual(keys('missing'), keys());
  assert.deepEqual(keys('lr', 'nees').sort(), keys().sort());
});

test('a row of the displayed filter is compared by its sensor faults', () => {
  assert.equal(comparedWith(ROW, 'a', 'b'), 'filter=a');
  assert.equal(comparedWith(ROW, 'a', 'a'), 'faults=blackout%3D0.4');
});

test('only a row of the displayed task can be compared', () => {
  assert.equal(whyNotCompared(ROW, ROW.task), '');
  assert.match(whyNotCompared(ROW, 'push_field'), /is of task push field: open an episode/);
});

test('the order survives the permalink', () => {
  for (const text of ['error', '-nees', '-name']) assert.equal(sortText(parseSort(text)), text);
});

test('rows of different faults have different keys', () => {
  assert.notEqual(rowKey(ROWS[0]), rowKey(ROWS[1]));
});

test('steps of ticks are 1, 2 or 5 times a power of ten, and at least as large as required', () => {
  for (const step of [0.0011, 0.2, 0.21, 1, 3.3, 7, 9999]) {
    const nice = niceStep(step);
    assert.ok(nice >= step * (1 - 1e-12) && nice <= 2.5 * step);
    assert.match(nice.toExponential(6), /^[125]\.000000e/);
  }
});

test('an axis is logarithmic if positive values differ by more than a factor of 100', () => {
  /** @param {number[]} values */
  const axisOf = (...values) =>
    scale(
      values.map((error) => ({ ...ROW, error })),
      ({ error }) => error,
      () => 0,
    );
  const texts = (/** @type {ReturnType<typeof axisOf>} */ axis) => axis.ticks.map(axis.text);
  assert.deepEqual(texts(axisOf(1e-5, 1e-2)), ['0.00001', '0.0001', '0.001', '0.01']);
  assert.deepEqual(texts(axisOf(1, 5)), ['1', '2', '3', '4', '5']);
  for (const values of [
    [1e-5, 3e-4, 1e-2],
    [0, 1, 500],
    [-1, 2, 900],
    [2, 2],
  ]) {
    const axis = axisOf(...values);
    const places = [...values, ...axis.ticks].map(axis.share);
    assert.ok(places.every((share) => share >= -1e-9 && share <= 1 + 1e-9));
    assert.deepEqual(values.map(axis.share), values.map(axis.share).sort());
  }
  assert.ok(Math.abs(axisOf(1e-5, 1e-2).share(10 ** -3.5) - 0.5) < 1e-12);
});

test('bars below zero do not make an axis linear', () => {
  const groups = [1.2, 8, 470].map((nees) => ({ ...ROW, nees }));
  const axis = scale(
    groups,
    ({ nees }) => nees,
    ({ nees }) => (nees === 470 ? 900 : 0.5),
  );
  assert.deepEqual(axis.ticks.map(axis.text), ['1', '10', '100', '1000']);
  assert.equal(axis.share(470 - 900), 0);
  assert.ok(axis.share(1.2) > 0 && axis.share(470 + 900) < 1);
});

/** @param {object[]} changes of `ROW`, each with another checkpoint */
const rowsOf = (...changes) =>
  changes.map((change, i) => ({ ...ROW, checkpoint: String(i).repeat(64), ...change }));

test('checkpoints that differ by their seed are one group with mean and standard deviation', () => {
  const rows = rowsOf(
    { error: 1, nees: null, provenance: '{"lr": 1, "seed": 0, "run": "https://tracker/1"}' },
    { error: 3, nees: null, provenance: '{"data": {"seed": 1}, "lr": 1}' },
    { error: 9, provenance: '{"lr": 2}' },
    { error: 5, provenance: '{"lr": 1}', faults: '' },
  );
  const groups = seedGroups(rows, settingEntries(rows));
  assert.deepEqual(
    groups.map(({ name, members, error }) => [name, members.length, error]),
    [
      ['crossmodal-ekf, lr 1', 2, 2],
      ['crossmodal-ekf, lr 2', 1, 9],
      ['crossmodal-ekf, lr 1', 1, 5],
    ],
  );
  assert.ok(Math.abs(Number(groups[0].spread.error) - Math.SQRT2) < 1e-12, 'sample deviation');
  assert.deepEqual([groups[0].nees, groups[1].spread], [null, {}]);
  assert.equal(seedGroups([...rows].reverse(), ['lr']).length, 3);
  assert.equal(new Set(groups.map(cellOf)).size, 3);
  assert.equal(
    cellOf(seedGroups([rows[1], rows[0]], ['lr'])[0]),
    cellOf(groups[0]),
    'whatever the order',
  );
});

test('a fine-tuned checkpoint is no seed of its base', () => {
  const training = { data: 'c'.repeat(64), finetuned: null };
  const tuned = (/** @type {number} */ seed) =>
    JSON.stringify({ ...training, finetuned: { seed, faults: 'blackout=0.8' } });
  const rows = rowsOf(
    { training: JSON.stringify(training) },
    { training: tuned(0) },
    { training: tuned(1) },
  );
  const groups = seedGroups(rows, []).map(({ name, members }) => [name, members.length]);
  assert.deepEqual(groups, [
    ['crossmodal-ekf', 1],
    ['crossmodal-ekf, fine-tuned', 2],
  ]);
});

test('faults of one kind have levels, and no fault has level 0', () => {
  const texts = [
    '',
    'blackout=0.4',
    'blackout=0.8',
    'force_bias:x=8',
    'contact_inverted',
    'a=1,b=2',
  ];
  const rows = rowsOf(...texts.map((faults) => ({ faults })));
  assert.deepEqual(faultKinds(rows), ['blackout', 'force_bias:x']);
  const levels = rows.map((row) => faultLevel(row, 'blackout'));
  assert.deepEqual(levels, [0, 0.4, 0.8, null, null, null]);
});

/** @param {Record<string, unknown>[]} entries provenance of checkpoints */
const recorded = (...entries) =>
  rowsOf(...entries.map((provenance) => ({ provenance: JSON.stringify(provenance) })));

test('seeds, addresses, dates, and texts, ids and times of every checkpoint do not distinguish groups', () => {
  const rows = recorded(
    ...[0, 1, 2, 3].map((i) => ({
      dir: `/runs/${i}`,
      date: `2026-11-2${i % 2}T10:00`,
      random_seed: i,
      trainSeed: i,
      seed: { value: i },
      run_id: 100 + i,
      started_at: 1764361200.5 + 600 * i,
      train: { wallTime: 612 - i },
      time_step: 0.1 * (i % 2),
      url: `https://tracker/${i % 2}`,
      env_id: i < 2 ? 'door' : 'push',
      lr: ['1e-3', 3e-4][i % 2],
      dropout: 0.1 * (i % 3),
      width: 64,
      seeding: i < 2 ? 'grid' : 'random',
    })),
    {},
  );
  assert.deepEqual(settingEntries(rows), ['time_step', 'env_id', 'lr', 'dropout', 'seeding']);
  assert.deepEqual(groupEntries(rows, ''), settingEntries(rows));
  assert.deepEqual(groupEntries(rows, namesText(['lr', 'run_id', 'gone'])), ['run_id', 'lr']);
  assert.deepEqual(groupEntries(rows, ','), []);
  const twice = [...rows, ...rows.map((row) => ({ ...row, faults: '' }))];
  assert.deepEqual(settingEntries(twice), settingEntries(rows), 'each checkpoint counts once');
});

/** Two learning rates with three seeds each, and two checkpoints that were modified after the training. */
const SWEPT = recorded(
  ...[0, 1, 2, 3, 4, 5].map((i) => ({ lr: i < 3 ? 3e-3 : 1e-3, seed: i % 3, final_loss: -4 - i })),
  { lr: 3e-3, seed: 0, final_loss: -4, broken: 'gyro' },
  { lr: 3e-3, seed: 0, final_loss: -4, broken: 'sigma' },
);

test('an absent entry is a value, and results of the training are no settings', () => {
  assert.deepEqual(settingEntries(SWEPT), ['lr', 'broken']);
  const groups = seedGroups(SWEPT, settingEntries(SWEPT));
  assert.deepEqual(
    groups.map(({ name, members }) => [name, members.length]),
    [
      ['crossmodal-ekf, lr 0.003', 3],
      ['crossmodal-ekf, lr 0.001', 3],
      ['crossmodal-ekf, broken gyro, lr 0.003', 1],
      ['crossmodal-ekf, broken sigma, lr 0.003', 1],
    ],
  );
  assert.ok(!groups.some(repeatsSeed));
});

test('a group that repeats a seed is marked', () => {
  const groups = seedGroups(SWEPT, ['lr']);
  assert.deepEqual(groups.map(repeatsSeed), [true, false]);
  const columns = columnsOf(SWEPT, true, ['lr'], []);
  const seeds = columns.find(({ key }) => key === 'seeds');
  assert.deepEqual(
    groups.map((row) => seeds?.content(row)),
    ['5, repeated', '3'],
  );
  const unseeded = recorded({ lr: 1 }, { lr: 1 });
  assert.ok(!seedGroups(unseeded, []).some(repeatsSeed));
});

test('numbers that hardly repeat are results if there are seeds, else settings', () => {
  const elbo = (/** @type {object} */ more) =>
    [1, 2, 3, 4].map((i) => ({ elbo: i / 7, loss_weight: i % 2, ...more, seed: i }));
  assert.deepEqual(settingEntries(recorded(...elbo({}))), ['loss_weight']);
  const unseeded = elbo({ acc: 1 }).map(({ seed, ...others }) => ({
    ...others,
    valLoss: seed % 2,
  }));
  assert.deepEqual(settingEntries(recorded(...unseeded)), ['elbo', 'loss_weight']);
  assert.deepEqual(settingEntries(recorded({ loss: 'l1' }, { loss: 'l2' }, { loss: 'l2' })), [
    'loss',
  ]);
});

test('groups are named by results of the training only if no setting distinguishes them', () => {
  const groups = seedGroups(SWEPT.slice(1, 4), ['final_loss', 'lr']);
  assert.deepEqual(
    groups.map(({ name }) => name),
    [
      'crossmodal-ekf, lr 0.003, final_loss −5',
      'crossmodal-ekf, lr 0.003, final_loss −6',
      'crossmodal-ekf, lr 0.001, final_loss −7',
    ],
  );
});

test('a checkpoint without provenance does not make columns of equal entries', () => {
  assert.deepEqual(differingEntries(recorded({ a: 1, b: 1 }, {}, { a: 1, b: 2 })), ['b']);
  assert.deepEqual(differingEntries(recorded({ a: 1 }, {})), []);
});

test('at most 100 entries are columns, the pinned ones among them, and conditions use all', () => {
  const keys = Array.from({ length: 130 }, (_, i) => `p${i}`);
  const rows = recorded(...[1, 2].map((value) => Object.fromEntries(keys.map((k) => [k, value]))));
  const { entries, count } = entryColumns(rows, ['p120']);
  assert.deepEqual(
    [entries.length, count, entries.at(-1), entries.at(-2)],
    [100, 130, 'p120', 'p98'],
  );
  assert.equal(matching(rows, 'p129>1').rows.length, 1);
});

test('the CSV has the displayed rows and columns with all digits', () => {
  const rows = recorded({ note: 'a, "b"', lr: 0.123456789 }, { note: 'c', lr: 1 }, { lr: 2 });
  rows[0].error = 1 / 3;
  const columns = columnsOf(rows, false, ['lr', 'note'], ['lr']);
  const lines = tableCsv(rows.slice(0, 2), columns).split('\n');
  assert.equal(
    lines[0],
    'checkpoint,lr,"RMSE, cm","hinge x, cm","hinge y, cm","angle, °",NEES/n,NLL,95 % coverage,"worst, cm",episodes,steps,note',
  );
  assert.equal(lines.length, 2 + 2); // with the title and the end
  assert.ok(lines[1].startsWith(`${rows[0].name},0.123456789,`));
  assert.ok(lines[1].includes(`,${1 / 3},`));
  assert.ok(lines[1].endsWith(',"a, ""b"""'));
  const [, last] = tableCsv(rows.slice(2), columns).split('\n');
  assert.ok(last.endsWith(','), 'an absent entry is empty');
});

test('errors of components are columns of the table, of conditions and of means', () => {
  const rows = rowsOf(
    { components: { angle_deg: 64, 'speed_m/s': 0.5, hinge_x_cm: 2, slip: 1 } },
    { components: { angle_deg: 2, 'speed_m/s': 0.1, hinge_x_cm: 2, slip: 1 }, nll: 1 },
  );
  const numbers = numbersOf(rows);
  assert.deepEqual(
    Object.entries(numbers)
      .map(([key, { title }]) => [key, title])
      .slice(0, 6),
    [
      ['error', 'RMSE'],
      ['angle_deg', 'angle, °'],
      ['speed_m/s', 'speed, m/s'],
      ['hinge_x_cm', 'hinge x, cm'],
      ['slip', 'slip'],
      ['nees', 'NEES/n'],
    ],
  );
  const count = (/** @type {string} */ text) => matching(rows, text).rows.length;
  for (const text of ['angle > 20', 'angle_deg>20', '"angle, °" > 20', 'speed>0.2', 'NLL<0'])
    assert.equal(count(text), 1, text);
  assert.equal(count('hinge_x = 2'), 2);
  assert.equal(numberOf(rows[0], 'angle_deg'), 64);
  const [group] = seedGroups(rows, []);
  assert.deepEqual([group.components.angle_deg, group.nll], [33, -1.125]);
  const column = columnsOf(rows, true, [], []).find(({ key }) => key === 'angle_deg');
  assert.equal(column?.content(group), '33.00 ± 43.84');
});

test('the CSV of means has their standard deviations', () => {
  const rows = recorded({ seed: 1 }, { seed: 2 });
  [rows[0].error, rows[1].error] = [1, 2];
  const columns = columnsOf(rows, true, [], []);
  const [head, line] = tableCsv(seedGroups(rows, []), columns).split('\n');
  assert.ok(head.includes('"RMSE, cm","RMSE, cm, standard deviation"'));
  assert.ok(line.includes(`,2,1.5,${Math.SQRT1_2},`), 'the number of checkpoints has no mark');
  assert.ok(!line.includes('±'));
});

test('groups are named by the fewest settings that distinguish them', () => {
  const rows = recorded(
    ...[
      [32, 1, 'a'],
      [32, 2, 'a'],
      [64, 1, 'b'],
      [64, 2, 'b'],
      [64, 3, 'b'],
    ].map(([width, lr, twin]) => ({ aaa: twin, width, lr })),
  );
  const labels = seedGroups(rows, settingEntries(rows)).map(({ name }) => name);
  assert.deepEqual(labels.slice(0, 2), [
    'crossmodal-ekf, lr 1, aaa a',
    'crossmodal-ekf, lr 2, aaa a',
  ]);
  assert.equal(new Set(labels).size, 5);
  assert.deepEqual(
    seedGroups(rows, ['width']).map(({ name, members }) => [name, members.length]),
    [
      ['crossmodal-ekf, width 32', 2],
      ['crossmodal-ekf, width 64', 3],
    ],
  );
});

test('the worst episode of a seed is found, and whether another seed has a worse one', () => {
  const episode = (/** @type {number} */ seed, /** @type {number} */ worst) =>
    /** @type {any} */ ({ seed, worst });
  const episodes = [episode(0, 1), episode(1, 5), episode(0, 4)];
  assert.deepEqual(worstOfSeed(episodes, 0), { result: episodes[2], isExceeded: true });
  assert.deepEqual(worstOfSeed(episodes, 1), { result: episodes[1], isExceeded: false });
  assert.equal(worstOfSeed(episodes, 2).result, undefined);
});
