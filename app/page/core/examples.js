/** Examples: links to runs that show one thing each. An address without a selection opens the first. */

/** @import { Catalog } from '../types/server.js' */

/** @typedef {{title: string, help: string, link: string}} Example */

/** @type {Example[]} */
const EXAMPLES = [
  {
    title: 'Camera outage',
    help: 'The camera goes dark during the first contact with a pushed object',
    link: '?task=push-field&filter=information-ekf&weights=effective',
  },
  {
    title: 'Outage at a door',
    help: 'The camera goes dark while a hand opens a door',
    link: '?task=door-field&filter=information-ekf&weights=effective',
  },
  {
    title: 'Frozen image',
    help: 'The camera repeats one image; the diagnosis names the cause',
    link: '?task=push&filter=crossmodal-ekf&step=50&faults=image_frozen%3Afrom%3D30&tab=diagnosis',
  },
  {
    title: 'Biased force sensor',
    help: 'A bias of 8 N; the diagnosis names the cause',
    link: '?task=push&filter=crossmodal-pf&step=40&faults=force_bias%3Ax%3D8&tab=diagnosis',
  },
  {
    title: '40 % image blackout',
    help: "The paper's fault: random single images are black",
    link: '?task=door&filter=crossmodal-pf&step=25&faults=blackout%3D0.4&weights=effective',
  },
];

/**
 * Returns the examples that a server can show; none if it was given filters or data of the user.
 * @param {Catalog} catalog
 */
export function examples({ own_files: ownFiles, tasks }) {
  return EXAMPLES.filter(({ link }) => {
    const query = new URLSearchParams(link);
    const task = tasks.find(({ name }) => name === query.get('task'));
    return !ownFiles && task?.filters.some(({ name }) => name === query.get('filter'));
  });
}
