/** Starts the page: loads the catalog and reads the state from the address. */

import * as api from '../data/api.js';
import { addLiveRuns, awaitedRun } from '../tabs/live_runs.js';
import { Messages } from '../widgets/panel_state.js';
import { showError, showLoading } from './common_panels.js';
import { html, messageOf } from './dom.js';
import { Page } from './page.js';
import { disableChanges } from './read_only.js';
import { Store, completeLink, parsePermalink } from './state.js';
import { sentence } from './units.js';

const messages = new Messages(html('#messages'));

showLoading('Loading …');
start().catch((error) => messages.show('start', showError(error)));

async function start() {
  const [catalog, live] = await Promise.all([
    loadCatalog(),
    api.liveRuns().catch(() => ({ runs: [], tasks: [] })),
  ]);
  addLiveRuns(catalog, live);
  messages.show('catalog', catalog.problems.map(sentence).join(' '));
  html('#read-only').hidden = !catalog.read_only;
  if (catalog.read_only) disableChanges(document.body);
  if (!catalog.tasks.length)
    throw new api.ServerError(
      'Nothing to display: no task has both episodes and a trained filter.',
    );
  const isAwaited = Boolean(awaitedRun(location.search, live));
  const link = completeLink(isAwaited ? '' : location.search, catalog, isAwaited ? [] : live.runs);
  const { state, problems } = parsePermalink(link, catalog);
  if (state.faults)
    await api.checkSelection({ ...state, against: '' }).catch((error) => {
      problems.push(
        `The link has an invalid fault injection “${state.faults}”: ${withoutList(messageOf(error))}`,
      );
      state.faults = '';
    });
  messages.show('link', problems.join('\n'));
  new Page(new Store(state, catalog), live, messages);
}

/** Loads the catalog, with the link's checkpoints of sweeps, which a new server does not list. */
async function loadCatalog() {
  const catalog = await api.catalog();
  const query = new URLSearchParams(location.search);
  const task = catalog.tasks.find(({ name }) => name === query.get('task'));
  const other = new URLSearchParams(query.get('against') ?? '').get('filter');
  const unlisted = [query.get('filter') ?? '', other ?? ''].filter(
    (text) => /-[0-9a-f]{8}$/.test(text) && !task?.filters.some(({ name }) => name === text),
  );
  return task && unlisted.length ? api.catalog(task.name, unlisted) : catalog;
}

/**
 * Returns a message without the list of all names where it suggests similar ones.
 * @param {string} message
 */
function withoutList(message) {
  return message.replace(/( Did you mean .*\?) Available: .*$/, '$1');
}
