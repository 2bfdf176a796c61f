/** A cause in the Diagnosis tab: its probability, evidence, the effect of undoing it and the next action. */

/** @import { ReadingCharts } from '../timeline/reading_charts.js' */
/** @import { Diagnosis, DiagnosisCause, Evidence } from '../types/server.js' */

import { create, createButton } from '../core/dom.js';
import {
  displayName,
  fixed,
  percent,
  probabilityText,
  sentence,
  stepLabel,
  typeset,
} from '../core/units.js';
import { copyButton } from '../widgets/copy_button.js';

/** @typedef {(episode: number, step: number | null) => void} OpenStep step: null if the evidence has none */
/** How texts name several episodes. @typedef {{noun: string, name: (episode: number) => string | number}} Names */

/** Episodes of one data set. @type {Names} */
export const EPISODES = { noun: 'episode', name: (episode) => episode };

const PRESENT = 'Probability that this cause is present, alone or together with another one';

/**
 * @param {DiagnosisCause} cause
 * @param {Names | null} names null if the displayed episode is the only one
 * @param {OpenStep} open
 * @param {ReadingCharts} charts
 * @param {HTMLElement[]} actions after the next action
 */
export function causeItem(cause, names, open, charts, actions) {
  const { probability, recovered, evidence, steps } = cause;
  const bar = create('meter', { min: 0, max: 1, value: probability });
  bar.setAttribute('aria-label', `Probability of ${cause.title}`);
  const plural = cause.episodes.length === 1 ? '' : 's';
  const where = names
    ? [`${names.noun}${plural} ${cause.episodes.map(names.name).join(', ')}`]
    : [];
  if (steps) where.push(`steps ${steps[0]} to ${steps[1] - 1}`);
  /** @type {HTMLElement[]} */
  const lines = [
    create('p', { className: 'where', textContent: sentence(where.join(', ')) }),
    create('ul', {}, ...evidence.map((item) => evidenceItem(item, names, open, charts))),
  ];
  if (recovered) lines.push(create('p', { textContent: recoveredText(recovered) }));
  lines.push(nextAction(cause.next), ...actions);
  return create(
    'li',
    {},
    create('h4', { textContent: cause.title, title: cause.cause }),
    bar,
    create('output', {
      textContent: `probability ${probabilityText(probability)}`,
      title: PRESENT,
    }),
    create('div', { className: 'details' }, ...lines),
  );
}

/**
 * The largest error of several episodes as an evidence; the headline has that of one.
 * @param {Pick<Diagnosis, 'episodes' | 'largest_error'> | null | undefined} result
 */
export function largestError(result) {
  if (!result?.largest_error || result.episodes === 1) return [];
  const { episode, step, size, sources } = result.largest_error;
  const text = `largest ${size}${sources && ` (${sources})`}`;
  return [{ text, episode, step, time: null, sensor: '' }];
}

/**
 * @param {Pick<Evidence, 'text' | 'episode' | 'step' | 'time' | 'sensor'>} evidence
 * @param {Names | null} names null if the displayed episode is the only one
 * @param {OpenStep} open
 * @param {ReadingCharts} charts
 */
export function evidenceItem({ text, episode, step, time, sensor }, names, open, charts) {
  const item = create('li', { textContent: typeset(sentence(text)) });
  const label = placeLabel({ episode, step, time }, names);
  if (episode !== null && label)
    item.append(
      ' ',
      createButton('text quiet', label, () => open(episode, step)),
    );
  if (charts.has(sensor)) {
    const title = `Show the readings of ${displayName(sensor)} in the timeline`;
    item.append(
      ' ',
      createButton('text quiet', 'chart', () => charts.show(sensor), { title, ariaLabel: title }),
    );
  }
  return item;
}

/**
 * Names the episode and the step that show an evidence; empty without a step of the only episode.
 * @param {Pick<Evidence, 'episode' | 'step' | 'time'>} evidence
 * @param {Names | null} names null if the displayed episode is the only one
 */
export function placeLabel({ episode, step, time }, names) {
  const parts = names && episode !== null ? [`${names.noun} ${names.name(episode)}`] : [];
  if (step !== null) parts.push(stepLabel(step, time));
  return parts.join(', ');
}

/**
 * Whether the next action of a cause is a fine-tuning run, unlike that of a sensor that must be repaired.
 * @param {Pick<DiagnosisCause, 'next'>} cause
 */
export const isTrainable = ({ next }) => next.includes('`beliefscope finetune ');

/** @param {NonNullable<DiagnosisCause['recovered']>} recovered */
export function recoveredText({ error, low, high, nll, measure }) {
  const change = (nll ?? 0) < 0 ? 'increases' : 'decreases';
  const size = nll === null ? '?' : fixed(Math.abs(nll), 2);
  const likelihood = `the negative log-likelihood ${change} by ${size} nats per step`;
  if (error === null) return `If undone, ${likelihood}.`;
  const range = low === null || high === null ? '' : ` (${percent(low)} to ${percent(high)})`;
  if (!Math.round(100 * error)) return `Undoing it does not change the error; ${likelihood}.`;
  if (error < 0)
    return `Undoing it does not help: the ${measure} error increases by ${percent(-error)}; ${likelihood}.`;
  return `Undoing it removes ${percent(error)}${range} of the ${measure} error; ${likelihood}.`;
}

/**
 * The next action; its commands, between backticks, can be copied.
 * @param {string} text
 */
function nextAction(text) {
  const line = create('p', { className: 'next' }, 'Next: ', ...withCode(text));
  for (const { textContent } of line.querySelectorAll('code'))
    line.append(
      ' ',
      copyButton('Copy', 'Copy the command', () => textContent ?? ''),
    );
  return line;
}

/**
 * Parts of a text; those between backticks are code, the others are typeset.
 * @param {string} text
 */
export const withCode = (text) =>
  text.split('`').map((part, i) => (i % 2 ? create('code', { textContent: part }) : typeset(part)));
