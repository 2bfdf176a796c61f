/** What the Study tab shows for a task that no study contains: where there are results, and how to make some. */

/** @import { Store } from '../core/state.js' */
/** @import { StudyInfo } from '../types/server.js' */

import { createButton } from '../core/dom.js';
import { emptyNote } from '../widgets/empty_note.js';
import { firstRun } from '../widgets/pickers.js';

const SINGLE = ['image', 'haptics']; // modalities with a filter of their own
const ABOUT =
  'A study trains several filters with several seeds and compares their errors, so that differences between filters are not due to a single training.';

/**
 * Returns the elements of the note.
 * @param {StudyInfo} study the selected one
 * @param {Store} store
 */
export function missingStudy(study, store) {
  const { task: name } = store.state;
  const selected = store.task(name);
  const buttons = store.catalog.tasks
    .filter((task) => study.tasks.some((other) => other.name === task.name))
    .map((task) => createButton('text', task.name, () => store.set(firstRun(task, store.state))));
  const source = study.name === 'shipped' ? 'built-in study' : `study ${study.name}`;
  return emptyNote({
    title: `No study of ${name} yet`,
    paragraphs: [
      [ABOUT],
      ...(buttons.length ? [[`The ${source} has results for `, ...buttons]] : []),
    ],
    purpose: `To create one, ${selected?.simulated ? 'collect data' : 'use your data'} of ${name}, train, and serve the results.`,
    commands: studyCommands(name, selected?.modalities ?? [], selected?.simulated ?? false),
  });
}

/**
 * Commands that make a study of a task: the crossmodal filter beside those of one modality.
 * @param {string} task
 * @param {readonly string[]} modalities
 * @param {boolean} simulated whether its data can be collected
 */
export function studyCommands(task, modalities, simulated) {
  const single = modalities.filter((name) => SINGLE.includes(name));
  const filters = ['crossmodal', ...single].map((name) => ` --filter ${name}-ekf`).join('');
  return [
    ...(simulated ? [`beliefscope collect ${task} --episodes 300 -o ${task}.h5`] : []),
    `beliefscope study --task ${task} --data ${task}=${task}.h5${filters} -o study`,
    'beliefscope serve --study study',
  ];
}
