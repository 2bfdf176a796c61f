/** Quantities of a study, and the failures that explain them. */

/** @import { State } from '../core/state.js' */
/** @import { StudyRow, Task } from '../types/server.js' */

import {
  columnName,
  displayName,
  displayUnit,
  mainName,
  mainUnit,
  percent,
} from '../core/units.js';

/**
 * @typedef {object} Quantity
 * @property {string} key of the study's metrics
 * @property {string} component state component; empty for NEES/n
 * @property {string} title
 * @property {string} unit
 * @property {string} description
 */

/**
 * Returns the quantities of a study for a task: the RMSE of the main error and of the components, and NEES/n.
 * @param {StudyRow[]} rows
 * @param {Task} task
 * @returns {Quantity[]}
 */
export function studyQuantities(rows, task) {
  const { main } = task;
  const keys = new Set(rows.flatMap((row) => Object.keys(row.mean)));
  const errors = [...keys].flatMap((key) => {
    if (key === main.key) return [{ key, component: main.name, unit: mainUnit(task).unit }];
    const component = task.components.find((c) => key === columnName(c.name, c.display_unit));
    return component ? [{ key, component: component.name, unit: displayUnit(component).unit }] : [];
  });
  errors.sort((a, b) => Number(b.key === main.key) - Number(a.key === main.key));
  const quantities = errors.map((error) => {
    const isMain = error.key === main.key;
    const name = isMain ? main.name : displayName(error.component);
    return { ...error, title: isMain ? mainName(task) : name, description: `RMSE of the ${name}` };
  });
  if (rows.some((row) => typeof row.mean.nees === 'number'))
    quantities.push({
      key: 'nees',
      component: '',
      title: 'NEES/n',
      unit: '',
      description: 'NEES/n',
    });
  return quantities;
}

/**
 * Returns the changes of the state that list the failures of a filter at a share of image blackout.
 * @param {State} state
 * @param {Task} task
 * @param {string} filter
 * @param {number | null} blackout
 * @param {Quantity} quantity ranks the failures
 * @returns {Partial<State>}
 */
export function failuresOf(state, task, filter, blackout, { key, component }) {
  const isAngle = task.components.some(({ name, unit }) => name === component && unit === 'rad');
  const isNees = key === 'nees';
  return {
    task: task.name,
    filter,
    data: state.task === task.name ? state.data : task.data[0].name,
    faults: blackout ? `blackout=${blackout}` : '',
    against: '',
    tab: 'failures',
    list: 'events',
    among: 'held-out',
    by: isNees ? 'nees' : isAngle ? component : 'error',
    phase: '',
    component: isAngle ? component : task.map.components[0],
    track: isNees ? 'nees' : 'error',
  };
}

/**
 * Describes where the runs of a row start.
 * @param {string} start of a row: `3cm,20deg`, or empty
 */
export const startLabel = (start) =>
  start
    ? `${start.replaceAll('deg', '°').replaceAll('cm', ' cm').replaceAll(',', ', ')} off`
    : 'at the truth';

/** @param {number | null} share */
export const blackoutLabel = (share) => `${percent(share)} blackout`;
