/** What the page asks of its server over HTTP (docs/api.md). */

import { Trace } from './trace.js';

/**
 * @typedef {{name: string, unit: 'm' | 'rad'}} Component
 * @typedef {{index: number, steps: number, policy: string, split: string, seed: number, contact_fraction: number}} Summary
 * @typedef {object} Task
 * @property {string} name @property {Component[]} components @property {string[]} modalities @property {number} dt s
 * @property {{x: string, y: string, half_width: number}} map
 * @property {{name: string, kind: string, checkpoint_hash: string}[]} filters @property {Summary[]} episodes
 * @property {{name: string, recipe: string}[]} recipes that are ready to be picked
 * @typedef {{name: string, default: number | string | null, unit: string, meaning: string}} Parameter
 * @typedef {{fault: string, meaning: string, parameters: Parameter[]}} Fault
 * @typedef {{version: string, tasks: Task[], faults: Fault[], problems?: string[]}} Catalog
 * @typedef {{name: string, url: string, bytes: number, seconds: number}} Recording
 */

const AGAIN = 150; // ms until a trace that is being computed is asked for again
const RECORDED_MAPS = 40; // sets of maps that a recording holds: a few seconds to compute

/** An answer that says what is wrong, in a line that a person can read. */
export class ServerError extends Error {}

/** @param {string} url @param {RequestInit} [options] @returns {Promise<Response>} Raises ServerError. */
async function ask(url, options) {
  let response;
  try {
    response = await fetch(url, options);
  } catch (error) {
    if (error.name === 'AbortError') throw error;
    throw new ServerError('The server does not answer. Is `beliefscope serve` still running?');
  }
  if (response.ok) return response;
  const body = await response.json().catch(() => ({}));
  throw new ServerError(body.error ?? `The server answered ${response.status} ${response.statusText}.`);
}

const post = (url, body) =>
  ask(url, { method: 'POST', headers: { 'content-type': 'application/json' }, body: JSON.stringify(body) });

/** @returns {Promise<Catalog>} */
export const catalog = async () => (await ask('/api/catalog')).json();

/** @param {boolean} dark @returns {Promise<{view: string, scene: string, socket: string}>} */
export const openView = async (dark) => (await post('/api/views', { dark })).json();

/**
 * Raises ServerError where there is no such trace: an unknown name, or a recipe that cannot be.
 * @param {string} task @param {string} filter @param {number} episode @param {string} recipe
 */
export const check = (task, filter, episode, recipe) => ask(traceUrl(task, filter, episode) + asked(recipe));

const traceUrl = (task, filter, episode) => `/api/trace/${encodeURIComponent(task)}/${encodeURIComponent(filter)}/${episode}`;
const asked = (recipe) => `?${new URLSearchParams({ recipe })}`;

/**
 * A trace with all its numbers and pictures; the server computes it first if need be.
 * @param {Task} task @param {string} filter @param {number} episode @param {string} recipe how the sensors are broken
 * @param {(share: number) => void} progress @param {AbortSignal} signal
 * @returns {Promise<Trace>}
 */
export async function loadTrace(task, filter, episode, recipe, progress, signal) {
  const url = traceUrl(task.name, filter, episode);
  const query = asked(recipe);
  let response = await ask(url + query, { signal });
  while (response.status === 202) {
    progress((await response.json()).progress);
    await new Promise((resolve) => setTimeout(resolve, AGAIN));
    response = await ask(url + query, { signal });
  }
  const header = await response.json();
  const hasPictures = task.modalities.includes('image');
  const [columns, pictures] = await Promise.all([
    ask(`${url}/columns${query}`, { signal }).then((r) => r.arrayBuffer()),
    hasPictures ? ask(`${url}/images${query}`, { signal }).then((r) => r.arrayBuffer()) : null,
  ]);
  return new Trace(task, filter, episode, header, columns, pictures);
}

/** Writes a recording of a trace, with maps at even steps. @param {Trace} trace @returns {Promise<Recording>} */
export async function record(trace) {
  const maps = Math.ceil(trace.steps / RECORDED_MAPS);
  const { task, filter, episode, header } = trace;
  return (await post('/api/recordings', { task: task.name, filter, episode, recipe: header.recipe, maps })).json();
}
