/** The horizontal axis of the timeline: numbers of steps, or their times in s. */

/**
 * @typedef {object} StepAxis
 * @property {boolean} inSeconds
 * @property {(step: number) => number} position of a step, which may have a fraction
 * @property {(position: number) => number} step at a position, with a fraction
 */

/** @type {StepAxis} */
export const STEPS = { inSeconds: false, position: (step) => step, step: (position) => position };

/**
 * Returns the axis of a trace in s: linear between its steps, and with the task's duration of a step beyond them.
 * @param {{steps: number, dt: number, seconds: (step: number) => number}} trace may grow
 * @returns {StepAxis}
 */
export function secondsAxis(trace) {
  const last = () => Math.max(trace.steps - 1, 0);
  return {
    inSeconds: true,
    position(step) {
      const first = Math.min(Math.max(Math.floor(step), 0), last());
      const start = trace.seconds(first);
      const isBetween = step > first && first < last();
      const duration = isBetween ? trace.seconds(first + 1) - start : trace.dt;
      return start + (step - first) * duration;
    },
    step(position) {
      let [low, high] = [0, last()]; // the last step that is not later
      while (low < high) {
        const middle = Math.ceil((low + high) / 2);
        if (trace.seconds(middle) <= position) low = middle;
        else high = middle - 1;
      }
      const start = trace.seconds(low);
      const isBetween = position > start && low < last();
      return low + (position - start) / (isBetween ? trace.seconds(low + 1) - start : trace.dt);
    },
  };
}
