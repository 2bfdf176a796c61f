/** The lineage of a task's filters: fine-tuned checkpoints below their base checkpoints, with their errors. */

/** @import { State, Store } from '../core/state.js' */
/** @import { Catalog, LineageMember, Task } from '../types/server.js' */

import { create } from '../core/dom.js';
import { permalink } from '../core/state.js';
import { fixed } from '../core/units.js';
import * as api from '../data/api.js';

export class Lineage {
  #host;
  #catalog;
  #store;

  /**
   * @param {HTMLElement} host hidden if the task has no fine-tuned checkpoint
   * @param {Catalog} catalog
   * @param {Store} store
   */
  constructor(host, catalog, store) {
    this.#host = host;
    this.#catalog = catalog;
    this.#store = store;
    host.hidden = true;
  }

  /** @param {AbortSignal} signal */
  async load(signal) {
    const { members } = await api.lineage(this.#store.state.task, signal);
    const hashes = new Set(members.map(({ hash }) => hash));
    const bases = new Set(members.map(({ base }) => base));
    const roots = members.filter(({ hash, base }) =>
      base === null ? bases.has(hash) : !hashes.has(base),
    );
    this.#host.hidden = !roots.length;
    const list = create('ul', {}, ...roots.map((root) => this.#branch(root, null, members)));
    this.#host.replaceChildren(create('h4', { textContent: 'Lineage' }), list);
  }

  /**
   * Returns a checkpoint with the checkpoints that were fine-tuned from it.
   * @param {LineageMember} member
   * @param {LineageMember | null} base
   * @param {LineageMember[]} members all checkpoints
   * @returns {HTMLLIElement}
   */
  #branch(member, base, members) {
    const title = member.catalog_name ?? `${member.name} ${member.hash.slice(0, 6)}`;
    const name = create('b', { textContent: title, title: member.hash });
    const task = this.#catalog.tasks.find((each) => each.name === this.#store.state.task);
    const summary = create('span', {
      textContent: task ? errorSummary(member, base, task.main) : '',
    });
    const line = create('div', {}, name, ' ', summary, ...this.#links(member, base));
    const finetuned = members.filter((other) => other.base === member.hash);
    const branches = finetuned.map((other) => this.#branch(other, member, members));
    return create('li', {}, line, ...(branches.length ? [create('ul', {}, ...branches)] : []));
  }

  /**
   * @param {LineageMember} member
   * @param {LineageMember | null} base
   */
  #links({ catalog_name: name, hash, run }, base) {
    const { state } = this.#store;
    const label = name ?? hash.slice(0, 6);
    /**
     * @param {string} text
     * @param {Partial<State>} patch
     * @param {string} title
     */
    const pageLink = (text, patch, title) =>
      link(text, permalink({ ...state, run: '', ...patch }), `${title}: ${label}`);
    const baseName = base?.catalog_name;
    const links = [];
    if (name && name !== state.filter)
      links.push(pageLink('open', { filter: name, against: '' }, 'Show its runs'));
    if (name && baseName) {
      const patch = { filter: name, against: `filter=${baseName}`, tab: 'compare' };
      links.push(pageLink('compare', patch, 'Compare with its base checkpoint'));
    }
    if (run) links.push(pageLink('report', { run }, 'Changes made by fine-tuning'));
    const file = `/api/lineage/${encodeURIComponent(state.task)}/${hash}.zip`;
    return [...links, link('export', file, `Download with its base checkpoints: ${label}`)];
  }
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
