import assert from 'node:assert/strict';
import test from 'node:test';

import { isRecordedOnly } from '../../app/page/core/episodes.js';
import { Store, completeLink, parsePermalink, permalink } from '../../app/page/core/state.js';
import { addLiveRuns, otherRun } from '../../app/page/tabs/live_runs.js';
import { Undo } from '../../app/page/core/undo.js';
import { history, runFrames } from './browser.js';
import { CATALOG, TASK } from './fixtures.js';

/** @param {string} search */
const stateOf = (search) => parsePermalink(search, CATALOG).state;

test('an empty link selects the first of everything', () => {
  const { state, problems } = parsePermalink('', CATALOG);
  assert.deepEqual(problems, []);
  assert.equal(state.filter, 'crossmodal-pf');
  assert.equal(state.episode, 9);
  assert.equal(state.component, 'hinge_x');
  assert.equal(state.tab, 'scene');
  assert.equal(state.angle, null);
  assert.equal(
    permalink(state),
    '?task=door&filter=crossmodal-pf&data=door&episode=9&step=2&component=hinge_x&weights=effective&track=error&tab=scene',
  );
});

test('an address without a task opens the first example', () => {
  const field = { ...TASK, name: 'field', filters: TASK.filters.slice(1) };
  const link = '?task=field&filter=crossmodal-ekf&weights=effective';
  const catalog = { ...CATALOG, tasks: [TASK, field], examples: [{ title: '', help: '', link }] };
  assert.equal(completeLink('', catalog), link);
  assert.equal(
    completeLink('?step=3&weights=raw', catalog),
    `${link.replace('effective', 'raw')}&step=3`,
  );
  const moment = { ...catalog, examples: [{ title: '', help: '', link: `${link}&step=4` }] };
  assert.equal(completeLink('?speed=2', moment), `${link}&step=4&speed=2`);
  assert.equal(completeLink('?episode=8', moment), `${link}&episode=8`);
  const others = ['?task=door', '?filter=crossmodal-pf', '?data=mine'];
  for (const search of others) assert.equal(completeLink(search, catalog), search);
  assert.equal(completeLink('?step=3', { ...CATALOG, examples: [] }), '?step=3');
});

test('live runs of one filter are all in the catalog', () => {
  const runs = ['tue', 'mon'].map((name) => ({
    name,
    data: `live:${name}`,
    task: 'rover',
    filter: 'recorded',
    kind: 'external',
    episode: 0,
    steps: 5,
    state: 'ended',
    message: '',
  }));
  const rover = { ...TASK, name: 'rover', filters: [], data: [] };
  const catalog = { ...CATALOG, tasks: [TASK] };
  addLiveRuns(catalog, /** @type {any} */ ({ runs, tasks: [rover] }));
  for (const search of ['?task=rover&data=live:mon', '?data=live:mon', '?task=rover']) {
    const { state, problems } = parsePermalink(completeLink(search, catalog), catalog);
    assert.deepEqual(problems, []);
    assert.equal(state.task, 'rover');
    assert.equal(state.filter, 'recorded');
    assert.equal(state.data, search.includes('mon') ? 'live:mon' : 'live:tue');
    assert.equal(isRecordedOnly(catalog, state), true);
  }
  assert.equal(isRecordedOnly(catalog, stateOf('')), false);
  const listed = /** @type {any} */ ([
    { name: 'damaged', state: 'damaged' },
    { ...runs[0], name: 'wed', data: 'live:wed', steps: 0, state: 'died' },
    ...runs,
  ]);
  const examples = [{ title: '', help: '', link: '?task=door&filter=crossmodal-pf' }];
  assert.equal(
    completeLink('', { ...catalog, examples }, listed),
    '?task=rover&filter=recorded&data=live%3Atue',
  );
  assert.equal(completeLink('', { ...catalog, examples: [] }, listed), '');
  assert.equal(completeLink('?task=door', { ...catalog, examples }, listed), '?task=door');
});

test('in place of a deleted run, the page shows another run of its task, or else a data set', () => {
  const run = { kind: 'external', episode: 0, state: 'ended', message: '', filter: 'recorded' };
  const [mon, tue] = ['mon', 'tue'].map((name) => ({
    ...run,
    name,
    data: `live:${name}`,
    steps: 5,
  }));
  const runs = /** @type {any} */ ([
    { ...tue, steps: 0, name: 'empty', data: 'live:empty', task: 'rover' },
    { ...tue, task: 'ship' },
    { ...mon, task: 'rover' },
  ]);
  const rover = { ...TASK, name: 'rover', filters: [], data: [] };
  const tasks = [rover, { ...rover, name: 'ship' }];
  const catalog = { ...CATALOG, tasks: [TASK] };
  addLiveRuns(catalog, { runs, tasks });
  const state = { ...stateOf(''), task: 'rover', data: 'live:deleted', faults: 'blackout=0.4' };
  assert.equal(otherRun(catalog, runs, state)?.data, 'live:mon');
  assert.equal(otherRun(catalog, runs.slice(0, 2), state)?.data, 'live:tue');
  addLiveRuns(catalog, { runs: [], tasks: [] });
  assert.deepEqual(catalog.tasks, [TASK], 'the task without runs is not offered');
  const first = otherRun(catalog, [], state);
  assert.deepEqual([first?.task, first?.data, first?.faults], [TASK.name, TASK.data[0].name, '']);
  assert.equal(otherRun({ ...catalog, tasks: [rover] }, [], state), null);
});

test('an episode opens at its finding, unless it is the first of its data set', () => {
  const openings = ['', '?episode=8', '?step=3', '?episode=8&step=3'].map((search) => {
    const { step, atFinding } = stateOf(search);
    return [step, atFinding];
  });
  assert.deepEqual(openings, [
    [2, false],
    [0, true],
    [3, false],
    [3, false],
  ]);
});

test('a permalink restores every key', () => {
  const search =
    '?task=door&filter=crossmodal-ekf&data=door&episode=8&step=3&component=angle&weights=effective' +
    '&track=nees&tab=compare&faults=blackout%3D0.4&against=filter%3Dx&window=1-3&diagnostic=consistency' +
    '&options=size%3D21&run=r&study=s&quantity=q&pin=step%3D2&by=angle&phase=contact&hide=map' +
    '&ground=image&height=belief&tint=share&scale=log&range=same&colours=cividis&over=held-out' +
    '&list=episodes&among=all&axes=world&regions=hidden&zoom=4&cloud=shown&beside=gain&start=truth&angle=0.5236';
  const { state, problems } = parsePermalink(search, CATALOG);
  assert.deepEqual(problems, []);
  const [expected, written] = [search, permalink(state)].map((text) => [
    ...new URLSearchParams(text),
  ]);
  assert.deepEqual(new Map(written), new Map(expected));
  assert.deepEqual(stateOf(permalink(state)), state);
});

test('links of earlier versions are read', () => {
  const state = stateOf('?recipe=blackout%3D0.4&weights=acting&list=moments&group=contact');
  assert.equal(state.faults, 'blackout=0.4');
  assert.equal(state.weights, 'effective');
  assert.equal(state.list, 'events');
  assert.equal(state.phase, 'contact');
});

test('unknown names are reported and replaced', () => {
  const search = '?filter=none&episode=77&step=-1&window=9-2&tab=none';
  const { state, problems } = parsePermalink(search, CATALOG);
  assert.equal(problems.length, 5);
  assert.match(
    problems.join('\n'),
    /filter “none”, which does not exist\. Available: crossmodal-pf/,
  );
  assert.match(problems.join('\n'), /episode “77”, which does not exist\. Available: 8 to 9/);
  assert.deepEqual(
    [state.filter, state.episode, state.step, state.window, state.tab],
    ['crossmodal-pf', 9, 0, '', 'scene'],
  );
});

test('each tab is listed once for a link with an unknown one', () => {
  const { problems } = parsePermalink('?tab=none', CATALOG);
  assert.equal(problems[0].match(/scene/g)?.length, 1);
});

test('listeners are called once per frame with all changes', () => {
  const store = new Store(stateOf(''));
  /** @type {string[][]} */
  const calls = [];
  store.listen((_, changed) => calls.push([...changed]));
  store.set({ step: 1 }, { inputTime: 5 });
  store.set({ step: 2, track: 'nees' });
  store.set({ step: 2 });
  assert.deepEqual(calls, []);
  runFrames();
  assert.deepEqual(calls, [['step', 'track']]);
  assert.equal(store.inputTime, null);
});

test('a component that the new task does not have is replaced by one of its map', () => {
  const [x, y] = TASK.components.map(({ unit }, i) => ({
    ...TASK.components[i],
    name: 'xyz'[i],
    unit,
  }));
  const push = {
    ...TASK,
    name: 'push',
    components: [x, y],
    map: { ...TASK.map, components: ['x', 'y'] },
  };
  const store = new Store(stateOf('?component=angle'), { ...CATALOG, tasks: [TASK, push] });
  store.set({ task: 'push' });
  assert.equal(store.state.component, 'x');
  store.set({ task: 'push', component: 'y' });
  assert.equal(store.state.component, 'y');
  store.set({ task: 'door', component: 'angle' });
  assert.equal(store.state.component, 'angle');
  runFrames();
});

test('a change of the selection adds a history entry', () => {
  const store = new Store(stateOf(''));
  const before = history.length;
  store.set({ episode: 8 });
  store.flush();
  assert.equal(history.length, before + 1);
  assert.match(history.at(-1) ?? '', /episode=8/);
});

test('undo and redo restore the selection with its step', () => {
  const store = new Store(stateOf('?step=2'), CATALOG);
  const undo = new Undo(store);
  store.set({ faults: 'blackout=1' });
  store.flush();
  store.set({ step: 3 });
  store.flush();
  undo.undo();
  assert.deepEqual([store.state.faults, store.state.step], ['', 2]);
  undo.redo();
  assert.deepEqual([store.state.faults, store.state.step], ['blackout=1', 3]);
  undo.redo();
  assert.equal(store.state.faults, 'blackout=1');
});
