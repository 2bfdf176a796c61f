/** All commands of the page: its tabs, buttons and choices, read from the page itself, and layouts and examples. */

/** @import { Page } from './page.js' */
/** @import { Store } from './state.js' */

import { episodes } from '../data/api.js';
import { FIND, episodeLabel } from '../widgets/pickers.js';
import { isComplete } from './episodes.js';
import { LAYOUTS } from './layouts.js';

const MAX_EPISODES = 30; // found by a query

/**
 * @typedef {object} Command
 * @property {string} group
 * @property {string} title
 * @property {string} [keys] shortcut
 * @property {string} [words] other words that find it
 * @property {() => void} run
 */

/** Choices whose options are commands. @type {[selector: string, group: string][]} */
const SELECTS = [
  ['#filter', 'Filter'],
  ['#task', 'Task'],
  ['#faults', 'Faults'],
  ['#data', 'Data'],
  ['#track', 'Chart'],
  ['#standalone', 'Standalone'],
  ['#speed', 'Speed'],
  ['#episode', 'Episode'],
];
/** @type {[selector: string, group: string][]} */
const RADIOS = [
  ['#components', 'Component'],
  ['#weights', 'Weights'],
  ['#maps-map', 'Maps'],
  ['#maps-tiles', 'Maps'],
];

/**
 * Returns the commands that are available now.
 * @param {Page} page
 * @returns {Command[]}
 */
export function commands(page) {
  return [
    ...tabCommands(page),
    ...actionCommands(page),
    ...LAYOUTS.map((layout) => ({
      group: 'Layout',
      title: `${layout.name}: ${layout.help}`,
      run: () => page.setLayout(layout),
    })),
    ...clickable('#intro .chip', 'Example'),
    ...RADIOS.flatMap(([selector, group]) => clickable(`${selector} input`, group)),
    ...SELECTS.flatMap(([selector, group]) => selectCommands(selector, group)),
  ];
}

/**
 * Returns the command that a query such as `31` or `step 31` stands for.
 * @param {Page} page
 * @param {string} query
 * @returns {Command[]}
 */
export function stepCommand(page, query) {
  const match = query.trim().match(/^(?:step\s+)?(\d+)$/i);
  if (!match) return [];
  const step = Number(match[1]);
  return [{ group: 'Go to', title: `Step ${step}`, run: () => page.goTo(step) }];
}

/**
 * Returns the episodes with all words of a query, for a data set that the catalog lists in part.
 * @param {Store} store
 * @param {string} query
 * @returns {Promise<Command[]>}
 */
export async function episodeCommands(store, query) {
  const { task, data } = store.state;
  const set = store.task(task)?.data.find(({ name }) => name === data);
  if (!set || isComplete(set) || !query.trim()) return [];
  const matches = await episodes(task, data, { query, limit: MAX_EPISODES });
  return matches.episodes.map((entry) => ({
    group: 'Episode',
    title: episodeLabel(entry),
    run: () => store.set({ episode: entry.index, step: 0, playing: false }),
  }));
}

/** @param {Page} page */
function tabCommands(page) {
  return [...document.querySelectorAll('[role=tab]')].map((tab) => ({
    group: 'Tab',
    title: tab.textContent ?? '',
    keys: tab.getAttribute('aria-keyshortcuts') ?? '',
    run: () => page.openTab(tab.id.replace('tab-', '')),
  }));
}

/**
 * @param {Page} page
 * @returns {Command[]}
 */
function actionCommands(page) {
  /** @type {[title: string, keys: string, run: () => void, control?: string, words?: string][]} */
  const actions = [
    ['Play or pause', 'space', () => page.clock.toggle()],
    ['Go to the finding', '', () => page.finding.goToMoment(performance.now())],
    ['Go to the largest visible error after the warm-up', 'e', () => page.goToLargestError()],
    ['Next failure', 'n', () => page.goToFailure(1, performance.now())],
    ['Previous failure', 'b', () => page.goToFailure(-1, performance.now())],
    ['Whole episode in the timeline', '0', () => page.timeline.showAll()],
    ['Timeline axis: steps or seconds', '', () => page.switchTimeAxis()],
    ['Change of the maps from this step', 'm', () => page.maps.togglePin(), '#maps-options .pin'],
    ['Save .rrd', 's', () => page.save(), '#save', 'download export recording'],
    ['Copy a link to this step', 'y', () => page.copyLink(), '', 'share address url permalink'],
    ['Undo the selection', 'ctrl z', () => page.undo.undo()],
    ['Redo the selection', 'ctrl shift z', () => page.undo.redo()],
    ['Jobs', 'j', () => page.jobs.toggleByKey()],
    ['Light or dark theme', 'd', () => page.theme.toggle()],
    ['Introduction and examples', '', () => page.intro.show()],
    ['Tour', '', () => page.tour.start()],
  ];
  const enabled = actions.filter(([, , , control]) => !control || isEnabled(control));
  const group = 'Action';
  const listed = enabled.map(([title, keys, run, , words]) => ({ group, title, keys, words, run }));
  const exports = clickable('#maps-options .export button', 'Action').map(({ title, run }) => ({
    group: 'Action',
    title: title === 'Copy' ? 'Copy the maps as an image' : `Export the maps as ${title}`,
    words: 'figure download save',
    run,
  }));
  const charts = clickable('#chart-menu .export button', 'Action').map(({ title, run }) => ({
    group: 'Action',
    title: `Export the timeline as ${title}`,
    words: 'figure charts download save paper',
    run,
  }));
  return [
    ...listed,
    ...clickable('#report', 'Action', { words: 'figures tables pdf download export' }),
    ...exports,
    ...charts,
    ...clickable('#help', 'Action', { title: 'Keyboard shortcuts', keys: '?' }),
  ];
}

/** @param {string} selector */
function isEnabled(selector) {
  const control = document.querySelector(selector);
  return control instanceof HTMLButtonElement && !control.disabled;
}

/**
 * @param {string} selector of buttons and radio buttons
 * @param {string} group
 * @param {Partial<Command>} [properties] the title is the text of the control by default
 * @returns {Command[]}
 */
function clickable(selector, group, properties) {
  return [...document.querySelectorAll(selector)].flatMap((control) => {
    const isControl = control instanceof HTMLButtonElement || control instanceof HTMLInputElement;
    if (!isControl || control.disabled) return [];
    const title = (control.closest('label') ?? control).textContent?.trim() ?? '';
    return [{ group, title, run: () => control.click(), ...properties }];
  });
}

/**
 * @param {string} selector
 * @param {string} group
 * @returns {Command[]}
 */
function selectCommands(selector, group) {
  const select = document.querySelector(selector);
  if (!(select instanceof HTMLSelectElement) || select.disabled || select.length < 2) return [];
  if (select.options[0].value === FIND) return []; // of many episodes: see episodeCommands
  return [...select.options].map(({ value, text }) => ({
    group,
    title: text,
    run: () => {
      select.value = value;
      select.dispatchEvent(new Event('change', { bubbles: true }));
    },
  }));
}
