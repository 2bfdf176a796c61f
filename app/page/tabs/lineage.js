/** Which filter was made from which: the children of the workspace under their ancestors, with what each gained and lost. */

import * as api from '../data/api.js';
import { permalink } from '../core/state.js';
import { fixed } from '../core/units.js';

export class Descent {
  #host;
  #store;

  /** @param {HTMLElement} host @param {import('../core/state.js').Store} store */
  constructor(host, store) {
    [this.#host, this.#store] = [host, store];
    host.hidden = true;
  }

  /** Asks anew, and shows the families that have children; nothing where there are none. */
  async load(signal) {
    const { task } = this.#store.state;
    const { members } = await api.lineage(task, signal);
    const byHash = new Map(members.map((one) => [one.hash, one]));
    const children = (hash) => members.filter(({ base }) => base === hash);
    const roots = members.filter(
      (one) => !byHash.has(one.base) && (one.base || children(one.hash).length),
    );
    this.#host.hidden = !roots.length;
    const list = document.createElement('ul');
    list.append(...roots.map((one) => this.#branch(one, null, children)));
    this.#host.replaceChildren(
      Object.assign(document.createElement('h4'), { textContent: 'Who was made from whom' }),
      list,
    );
  }

  #branch(one, parent, children) {
    const item = document.createElement('li');
    const line = document.createElement('div');
    const name = Object.assign(document.createElement('b'), {
      textContent: one.catalog_name ?? `${one.name} ${one.hash.slice(0, 6)}`,
      title: one.hash,
    });
    line.append(name, ' ', ...told(one, parent), ...this.#links(one, parent));
    item.append(line);
    const below = children(one.hash);
    if (below.length) {
      const list = document.createElement('ul');
      list.append(...below.map((child) => this.#branch(child, one, children)));
      item.append(list);
    }
    return item;
  }

  /** Ways to look at one; those of what is not on the shelf lead to its run, where it can be put there. */
  #links(one, parent) {
    const { state } = this.#store;
    const own = { task: state.task, data: state.data };
    const of = (text, patch, title) =>
      link(
        text,
        permalink({ ...state, ...patch, run: patch.run ?? '' }),
        `${title}: ${one.catalog_name ?? one.hash.slice(0, 6)}`,
      );
    const links = [];
    if (one.catalog_name && one.catalog_name !== state.filter)
      links.push(of('open', { ...own, filter: one.catalog_name, against: '' }, 'Show its runs'));
    if (one.catalog_name && parent?.catalog_name)
      links.push(
        of(
          'compare',
          { filter: one.catalog_name, against: `filter=${parent.catalog_name}`, tab: 'compare' },
          'Beside its parent',
        ),
      );
    if (one.run) links.push(of('report', { run: one.run }, 'What fine-tuning changed'));
    const zip = link(
      'export',
      `/api/lineage/${encodeURIComponent(state.task)}/${one.hash}.zip`,
      `With its ancestors, to hand on: ${one.catalog_name ?? one.hash.slice(0, 6)}`,
    );
    return [...links, zip];
  }
}

/** What it learned, and its error before and after; of a root its error. */
function told(one, parent) {
  const number = ({ position_cm: cm } = {}) => fixed(cm, 2);
  const muted = (text) => Object.assign(document.createElement('span'), { textContent: text });
  if (!one.base) return one.rmse.position_cm === undefined ? [] : [muted(`${number(one.rmse)} cm`)];
  const changes = Object.keys(one.after).map(
    (slice) => `${slice} ${number(one.before[slice])} → ${number(one.after[slice])}`,
  );
  const what = [one.train.join(', '), one.learned.length ? `on ${one.learned.join(' and ')}` : '']
    .filter(Boolean)
    .join(' ');
  return [
    muted(
      `${what}${changes.length ? `: ${changes.join(', ')} cm` : ''}${parent ? '' : `; made from ${one.base.slice(0, 6)}, which is not here`}`,
    ),
  ];
}

function link(text, href, title) {
  const made = Object.assign(document.createElement('a'), { href, textContent: text, title });
  made.setAttribute('aria-label', `${text}: ${title}`);
  return made;
}
