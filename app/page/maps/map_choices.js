/** What the maps show: the quantity, the components of their axes, and the treatment of the other components. */

/** @import { State } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */

/** @typedef {{quantity: State['map'], components: string[], others: string | null}} MapChoices as in a cursor (docs/api.md) */

/**
 * Returns the components of the axes. Components that the task does not have, as after a change of the task, are
 * replaced by those of its map.
 * @param {State} state
 * @param {Trace} trace
 */
export function mapPlane({ plane }, trace) {
  const names = plane.split(',');
  const isAvailable = names.every((name) =>
    trace.components.some((component) => component.name === name),
  );
  return isAvailable && new Set(names).size === 2 ? names : trace.task.map.components;
}

/**
 * @param {State} state
 * @param {Trace | null} trace
 * @returns {MapChoices}
 */
export function mapChoices(state, trace) {
  return {
    quantity: state.map,
    components: trace && state.plane ? mapPlane(state, trace) : [],
    others: state.others === 'auto' ? null : state.others,
  };
}
