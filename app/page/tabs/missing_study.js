/** What the Study tab shows for a task that no study contains: where there are results, and how to make some. */

/** @import { Store } from '../core/state.js' */
/** @import { Catalog, StudyInfo } from '../types/server.js' */

import { create } from '../core/dom.js';
import { copyButton } from '../widgets/copy_button.js';
import { firstRun } from '../widgets/pickers.js';

const SINGLE = ['image', 'haptics']; // modalities with a filter of their own

/**
 * Returns the elements of the note.
 * @param {StudyInfo} study the selected one
 * @param {Catalog} catalog
 * @param {Store} store
 */
export function missingStudy(study, catalog, store) {
  const { task: name } = store.state;
  const selected = catalog.tasks.find((task) => task.name === name);
  const tasks = catalog.tasks.filter((task) =>
    study.tasks.some((other) => other.name === task.name),
  );
  const buttons = tasks.map((task) => {
    const button = create('button', {
      type: 'button',
      className: 'text',
      textContent: `Show ${task.name}`,
    });
    button.addEventListener('click', () => store.set(firstRun(task, store.state)));
    return button;
  });
  const commands = studyCommands(name, selected?.modalities ?? []);
  return [
    create('h4', { textContent: `No study of ${name} yet` }),
    create('p', {
      textContent:
        'A study trains several filters with several seeds and compares their errors, so that differences between filters are not those of one training.',
    }),
    ...(tasks.length
      ? [
          create(
            'p',
            {},
            `The ${study.name === 'shipped' ? 'included study' : `study ${study.name}`} has results for `,
            ...buttons,
          ),
        ]
      : []),
    create(
      'p',
      {},
      `To make one, collect data of ${name}, train, and serve the results `,
      copyButton('Copy', 'Copy the commands', () => commands),
    ),
    create('pre', { textContent: commands }),
  ];
}

/**
 * Commands that make a study of a task: the crossmodal filter beside those of one modality.
 * @param {string} task
 * @param {readonly string[]} modalities
 */
export function studyCommands(task, modalities) {
  const single = modalities.filter((name) => SINGLE.includes(name));
  const filters = ['crossmodal', ...single].map((name) => ` --filter ${name}-ekf`).join('');
  return [
    `beliefscope collect ${task} --episodes 300 -o ${task}.h5`,
    `beliefscope study --task ${task} --data ${task}=${task}.h5${filters} -o study`,
    'beliefscope serve --study study',
  ].join('\n');
}
