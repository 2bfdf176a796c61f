/** Texts of the Diagnosis tab about a complete result. */

/** @import { Diagnosis as Result } from '../types/server.js' */

import { create } from '../core/dom.js';
import { displayName, percent, plural } from '../core/units.js';

const LISTED = 3; // statistics that were not measured

/**
 * The state of a finished diagnosis for its colour.
 * @param {Result} result
 */
export function findingOf({ state, masked, miscalibrated, episodes, largest_error }) {
  const overconfident = episodes === 1 && largest_error?.overconfident;
  if (state === 'healthy') return miscalibrated || overconfident ? 'miscalibrated' : state;
  return masked ? 'masked' : state;
}

/** @param {Result} result */
export function aboutOf({
  episodes,
  healthy_episodes: healthy,
  healthy_data: source,
  alarm_rate: rate,
  statistics,
  unmeasured,
}) {
  const text = `${plural(episodes, 'episode')} compared with ${plural(healthy, 'healthy one')}`;
  const numbers = Object.entries(statistics).map(
    ([name, count]) => `${displayName(name)} ${count}`,
  );
  const listed = unmeasured.slice(0, LISTED).join('; ');
  const more = unmeasured.length > LISTED ? `; and ${unmeasured.length - LISTED} more` : '';
  const missing = listed && ` Not measured: ${listed}${more}.`;
  return `${text}; statistics: ${numbers.join(', ')}; probability of a false alarm ${percent(rate)}.${missing}${source ? ` Healthy record: ${source}.` : ''}`;
}

/**
 * Keeps the options of a command from being broken after their hyphens.
 * @param {string} text
 */
export const wholeOptions = (text) =>
  text
    .split(/(--[\w-]+)/)
    .map((part, i) => (i % 2 ? create('span', { className: 'option', textContent: part }) : part));
