/** Charts of the readings of sensors that other parts of the page offer. */

/** @import { Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */

import { READINGS } from '../data/channels.js';
import { chartKeys, formatCharts } from './chart_list.js';
import { chartOptions } from './tracks.js';

/**
 * @typedef {object} ReadingCharts
 * @property {(sensor: string) => boolean} has whether there is a chart of a sensor, or of the controls: `control`
 * @property {(sensor: string) => void} show it below the other charts of the timeline
 */

/**
 * @param {Store} store
 * @param {() => Trace | null} trace the displayed one
 * @returns {ReadingCharts}
 */
export const readingCharts = (store, trace) => ({
  has: (sensor) => Boolean(trace()?.channels.of(READINGS + sensor).length),
  show: (sensor) => {
    const { state } = store;
    const run = trace();
    const available = run ? chartOptions(run, state.track).map(([key]) => key) : [];
    const keys = chartKeys(state, available);
    const key = READINGS + sensor;
    if (!keys.includes(key)) store.set({ charts: formatCharts([...keys, key]) });
  },
});
