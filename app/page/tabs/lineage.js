/** The lineage of a task's filters: fine-tuned checkpoints below their base checkpoints, with their errors. */

/** @import { State } from '../core/state.js' */
/** @import { LineageMember, Task } from '../types/server.js' */

import { create } from '../core/dom.js';
import { permalink } from '../core/state.js';
import { fixed } from '../core/units.js';

const ERRORS =
  'Errors of base checkpoints over the test episodes of their training data, and of fine-tuned ones over the ' +
  'windows of their validation, before → after.';

/**
 * Shows the lineage.
 * @param {HTMLElement} host hidden if the task has no fine-tuned checkpoint
 * @param {Task | undefined} task
 * @param {State} state
 * @param {LineageMember[]} members all checkpoints
 */
export function showLineage(host, task, state, members) {
  const hashes = new Set(members.map(({ hash }) => hash));
  const bases = new Set(members.map(({ base }) => base));
  const roots = members.filter(({ hash, base }) =>
    base === null ? bases.has(hash) : !hashes.has(base),
  );
  host.hidden = !roots.length;
  /**
   * Returns a checkpoint with the checkpoints that were fine-tuned from it.
   * @param {LineageMember} member
   * @param {LineageMember | null} base
   * @returns {HTMLLIElement}
   */
  const branch = (member, base) => {
    const title = member.catalog_name ?? `${member.name} ${member.hash.slice(0, 6)}`;
    const name = create('b', { textContent: title, title: member.hash });
    const textContent = task ? errorSummary(member, base, task.main) : '';
    const summary = create('span', { textContent });
    const line = create('div', {}, name, ' ', summary, ...links(state, member, base));
    const finetuned = members.filter((other) => other.base === member.hash);
    const branches = finetuned.map((other) => branch(other, member));
    return create('li', {}, line, ...(branches.length ? [create('ul', {}, ...branches)] : []));
  };
  const list = create('ul', {}, ...roots.map((root) => branch(root, null)));
  const note = create('p', { textContent: ERRORS });
  host.replaceChildren(create('h4', { textContent: 'Lineage' }), note, list);
}

/**
 * @param {State} state
 * @param {LineageMember} member
 * @param {LineageMember | null} base
 */
function links(state, { catalog_name: name, hash, run }, base) {
  const label = name ?? hash.slice(0, 6);
  /**
   * @param {string} text
   * @param {Partial<State>} patch
   * @param {string} title
   */
  const pageLink = (text, patch, title) =>
    link(text, permalink({ ...state, run: '', ...patch }), `${title}: ${label}`);
  const baseName = base?.catalog_name;
  const result = [];
  if (name && name !== state.filter)
    result.push(pageLink('open', { filter: name, against: '' }, 'Show its runs'));
  if (name && baseName) {
    const patch = { filter: name, against: `filter=${baseName}`, tab: 'compare' };
    result.push(pageLink('compare', patch, 'Compare with its base checkpoint'));
  }
  if (run) result.push(pageLink('report', { run }, 'Changes made by fine-tuning'));
  const file = `/api/lineage/${encodeURIComponent(state.task)}/${hash}.zip`;
  return [...result, link('export', file, `Download with its base checkpoints: ${label}`)];
}

/**
 * Returns the error of a checkpoint; of a fine-tuned one the training data and the errors before and after.
 * @param {LineageMember} member
 * @param {LineageMember | null} base null if it is not available
 * @param {Task['main']} main
 */
function errorSummary(
  { base: baseHash, rmse, before, after, train, learned },
  base,
  { key, unit },
) {
  /** @param {Record<string, number | null> | undefined} errors */
  const error = (errors) => fixed(errors?.[key], 2);
  if (baseHash === null) return Object.keys(rmse).length ? `${error(rmse)} ${unit}`.trim() : '';
  const changes = Object.keys(after).map(
    (slice) => `${slice} ${error(before[slice])} → ${error(after[slice])}`,
  );
  const training = [train.join(', '), learned.length ? `on ${learned.join(' and ')}` : ''];
  const text = training.filter(Boolean).join(' ');
  const errors = changes.length ? `: ${changes.join(', ')} ${unit}`.trimEnd() : '';
  return `${text}${errors}${base ? '' : `; base checkpoint ${baseHash.slice(0, 6)} is not available`}`;
}

/**
 * @param {string} textContent
 * @param {string} href
 * @param {string} title
 */
const link = (textContent, href, title) =>
  create('a', { href, textContent, title, ariaLabel: `${textContent}: ${title}` });
