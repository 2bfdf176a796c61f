/** The episodes of a checkpoint selected in the Experiments tab, or the checkpoints of a group, and how they open. */

/** @import { State, Store } from '../core/state.js' */
/** @import { EpisodeResult, ExperimentRow } from '../types/server.js' */
/** @import { SeedGroup } from './experiment_groups.js' */

import { HASH_DIGITS } from '../core/constants.js';
import { create, createButton, element, html, messageOf } from '../core/dom.js';
import { componentOf, permalink } from '../core/state.js';
import { fixed, significant, stepLabel } from '../core/units.js';
import * as api from '../data/api.js';
import { sortRows } from '../widgets/sorting.js';
import { comparedWith, rowKey, whyNotCompared } from './experiment_rows.js';

const LISTED = 50; // episodes, the worst first

/**
 * The episode with the largest error of one seed, and whether another seed has a larger one; none without results of
 * the seed.
 * @param {EpisodeResult[]} episodes
 * @param {number} seed
 */
export function worstOfSeed(episodes, seed) {
  const ordered = sortRows(episodes, ({ worst }) => worst, true);
  const result = ordered.find((episode) => episode.seed === seed);
  return { result, isExceeded: ordered.length > 0 && ordered[0].worst !== result?.worst };
}

export class EpisodePanel {
  #section;
  #store;
  #report;
  #sweep = '';
  /** The selected checkpoint. @type {ExperimentRow | undefined} */
  #row;
  /** @type {EpisodeResult[]} */
  #episodes = [];
  /** Seed of the runs that the page opens. */
  #openedSeed = 0;

  /**
   * @param {HTMLElement} section
   * @param {Store} store
   * @param {(problem: string) => void} report
   */
  constructor(section, store, report) {
    this.#section = section;
    this.#store = store;
    this.#report = report;
    html('.compare', section).addEventListener('click', () =>
      this.#openRow((row, filter) => ({
        tab: 'compare',
        // the sensor faults are compared if the filter is the same
        against: comparedWith(row, filter, store.state.filter),
      })),
    );
    html('.diagnose', section).addEventListener('click', () =>
      this.#openRow((row, filter) => ({
        ...this.#runOf(row, filter),
        tab: 'diagnosis',
        over: 'held-out',
      })),
    );
    store.when(['task'], () => this.#enableCompare());
  }

  #enableCompare() {
    const button = element('.compare', HTMLButtonElement, this.#section);
    button.title = this.#row ? whyNotCompared(this.#row, this.#store.state.task) : '';
    button.disabled = Boolean(button.title);
  }

  /**
   * Lists the episodes of a checkpoint, or the checkpoints of a group; hides the section without a selection.
   * @param {string} sweep
   * @param {string} steps phase of the results
   * @param {ExperimentRow | SeedGroup | undefined} selected
   */
  async show(sweep, steps, selected) {
    const section = this.#section;
    section.hidden = !selected;
    const members = selected && 'members' in selected ? selected.members : null;
    for (const name of ['.compare', '.diagnose']) html(name, section).hidden = Boolean(members);
    html('.seeds', section).textContent = '';
    [this.#sweep, this.#row] = [sweep, members ? undefined : selected];
    this.#enableCompare();
    if (!selected) return;
    if (members) {
      this.#showMembers(selected.name, members);
      return;
    }
    try {
      const reply = await api.experimentEpisodes(sweep, selected, steps);
      if (selected !== this.#row) return;
      [this.#episodes, this.#openedSeed] = [reply.episodes, reply.opened_seed];
    } catch (error) {
      this.#report(messageOf(error));
      return;
    }
    const faults = selected.faults && `, ${selected.faults}`;
    html('h4', section).textContent =
      `${selected.name}${faults}: ${this.#episodes.length} results, the worst first`;
    html('.seeds', section).textContent = this.#seedNote();
    html('ol', section).replaceChildren(
      ...this.#episodes.slice(0, LISTED).map((episode) => this.#episodeItem(selected, episode)),
    );
  }

  /** Names the seed of the runs that Compare and Diagnose open if the worst result has another one. */
  #seedNote() {
    const { result, isExceeded } = worstOfSeed(this.#episodes, this.#openedSeed);
    if (!this.#episodes.length || (result && !isExceeded)) return '';
    const seeds = [...new Set(this.#episodes.map(({ seed }) => seed))].sort((a, b) => a - b);
    return result
      ? `The worst result has another seed: Compare and Diagnose run this server's seed ${this.#openedSeed}, Diagnose at its worst episode, ${result.episode}.`
      : `The sweep has no results of this server's seed ${this.#openedSeed}, which Compare and Diagnose run. Serve with --seed ${seeds.join(' or ')} to open its results.`;
  }

  /**
   * Lists the checkpoints of a group.
   * @param {string} name
   * @param {ExperimentRow[]} members
   */
  #showMembers(name, members) {
    const faults = members[0].faults && `, ${members[0].faults}`;
    html('h4', this.#section).textContent =
      `${name}${faults}: ${members.length === 1 ? 'one checkpoint' : `mean of ${members.length} checkpoints, the worst first`}`;
    const items = sortRows(members, ({ error }) => error, true).map((row) => {
      const open = () => this.#store.set({ rows: 'checkpoints', cell: rowKey(row) });
      const button = createButton('text', row.name, open);
      const values = `RMSE ${fixed(row.error, 2)} ${row.unit}, NEES/n ${significant(row.nees)}`;
      return create('li', {}, button, create('span', { textContent: values }));
    });
    html('ol', this.#section).replaceChildren(...items);
  }

  /**
   * @param {ExperimentRow} row
   * @param {EpisodeResult} result
   */
  #episodeItem(
    row,
    { episode, seed, error, unit, worst, worst_step: step, worst_time: time, nees, policy },
  ) {
    const textContent = `Episode ${episode}, ${stepLabel(step, time)}`;
    const patch = (/** @type {string} */ filter) => ({
      ...this.#runOf(row, filter),
      episode,
      step,
      tab: 'scene',
    });
    const isOpened = seed === this.#openedSeed;
    const link = create(isOpened ? 'a' : 'span', { textContent });
    if (link instanceof HTMLAnchorElement) {
      link.href = permalink({ ...this.#store.state, ...patch(filterName(row)) });
      link.addEventListener('click', (event) => {
        if (event.ctrlKey || event.metaKey || event.shiftKey) return;
        event.preventDefault();
        this.#openRow((_, filter) => patch(filter));
      });
    } else link.title = `This server runs seed ${this.#openedSeed}: serve with --seed ${seed}`;
    const values = [`RMSE ${fixed(error, 2)} ${unit}`, `worst ${fixed(worst, 2)} ${unit}`];
    if (nees !== null) values.push(`NEES/n ${significant(nees)}`);
    if (!isOpened) values.push(`seed ${seed}, not of this server`);
    return create(
      'li',
      {},
      link,
      create('span', { textContent: [...values, policy].filter(Boolean).join(', ') }),
    );
  }

  /**
   * The displayed run of a row: its worst episode of the server's seed.
   * @param {ExperimentRow} row
   * @param {string} filter its name in the catalog
   * @returns {Partial<State>}
   */
  #runOf({ task, faults, data_name: data, worst_episode, worst_step }, filter) {
    const { result } = worstOfSeed(this.#episodes, this.#openedSeed);
    const episode = result?.episode ?? worst_episode ?? 0;
    const step = result?.worst_step ?? worst_step ?? 0;
    const [run, { component }] = [this.#store.task(task), this.#store.state];
    const place = { episode, step, against: '', playing: false };
    return {
      task,
      filter,
      faults,
      data: data ?? run?.data[0]?.name ?? '',
      component: run ? componentOf(run, component) : component,
      ...place,
    };
  }

  /**
   * Opens the selected checkpoint, which is added to the catalog if necessary.
   * @param {(row: ExperimentRow, filter: string) => Partial<State>} patch
   */
  async #openRow(patch) {
    const row = this.#row;
    if (!row) return;
    if (!row.data_name) {
      this.#report(
        `This server does not have the episodes of ${row.data_file} (${row.data.slice(0, 12)}), over which ${row.name} ran: serve them with --data.`,
      );
      return;
    }
    if (row.catalog_name) {
      this.#store.set(patch(row, row.catalog_name));
      return;
    }
    try {
      const filter = this.#store.catalog.read_only
        ? filterName(row)
        : (await api.addSweepFilter(this.#sweep, row.checkpoint)).filter;
      // Loads the catalog again.
      location.assign(`/${permalink({ ...this.#store.state, ...patch(row, filter) })}`);
    } catch (error) {
      this.#report(messageOf(error));
    }
  }
}

/**
 * Name of a row's filter in the catalog; one that is not listed yet is added when the page opens with this name.
 * @param {ExperimentRow} row
 */
const filterName = ({ catalog_name, name, checkpoint }) =>
  catalog_name ?? `${name}-${checkpoint.slice(0, HASH_DIGITS)}`;
