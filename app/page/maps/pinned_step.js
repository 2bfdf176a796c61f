/** The pinned step of the likelihood maps, as text in the state. */

/** @import { Selection } from '../types/server.js' */

/**
 * Writes a step of the page's task as URL parameters.
 * @param {Selection} selection
 * @param {number} step
 * @param {number | null} angle
 */
export function formatPin({ filter, data, episode, faults }, step, angle) {
  const query = new URLSearchParams({ filter, data, episode: String(episode), step: String(step) });
  if (faults) query.set('faults', faults);
  if (angle !== null) query.set('angle', angle.toFixed(4));
  return String(query);
}

/**
 * Reads a step from URL parameters.
 * @param {string} pin
 * @param {string} task
 */
export function parsePin(pin, task) {
  const query = new URLSearchParams(pin);
  const [filter, data, faults] = ['filter', 'data', 'faults'].map((key) => query.get(key) ?? '');
  const angle = query.get('angle');
  return {
    selection: { task, filter, data, episode: Number(query.get('episode')), faults },
    step: Number(query.get('step')),
    angle: angle === null ? null : Number(angle),
  };
}
