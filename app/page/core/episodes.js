/** Episodes of a data set. The catalog lists large data sets in part. */

/** @import { Catalog, DataSet, Task } from '../types/server.js' */

/** @param {Pick<DataSet, 'count' | 'episodes'>} set */
export const isComplete = ({ count, episodes }) => episodes.length === count;

/**
 * @param {DataSet} set
 * @param {number} index
 */
export const hasEpisode = (set, index) =>
  isComplete(set) ? set.episodes.some((episode) => episode.index === index) : index < set.count;

/** Returns the first and the last index. @param {DataSet} set */
export function episodeRange(set) {
  const indices = set.episodes.map(({ index }) => index);
  return isComplete(set) ? [Math.min(...indices), Math.max(...indices)] : [0, set.count - 1];
}

/**
 * Returns the filters of a task for a data set. A filter that is known only from live runs has only their data.
 * @param {Task} task
 * @param {string} data
 */
export const filtersOf = (task, data) => task.filters.filter(({ live }) => !live || live === data);

/**
 * Returns the first data set of a task that has a filter.
 * @param {Task} task
 */
export const firstData = (task) =>
  task.data.find(({ name }) => filtersOf(task, name).length) ?? task.data[0];

/**
 * Whether a filter is known only from its recorded runs, such as those of imported logs, and cannot run.
 * @param {Catalog} catalog
 * @param {{task: string, filter: string, data: string}} selection
 */
export function isRecordedOnly({ tasks }, { task: name, filter, data }) {
  const task = tasks.find((item) => item.name === name);
  const same = task ? filtersOf(task, data).find((item) => item.name === filter) : undefined;
  return Boolean(same?.live);
}
