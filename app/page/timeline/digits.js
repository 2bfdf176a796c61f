/** Decimals of the values of a chart. */

/** @import { Series } from './chart.js' */

/**
 * Number of decimals of the values, from 1 to 3, that fits their range: 1 from 5 on, 2 from 0.5 on.
 * @param {Pick<Series, 'values'>[]} series
 */
export function digitsOf(series) {
  let [low, high] = [Infinity, -Infinity];
  for (const { values } of series)
    for (const value of values)
      if (Number.isFinite(value)) [low, high] = [Math.min(low, value), Math.max(high, value)];
  const range = high - low;
  return range > 0 ? Math.min(3, Math.max(1, 1 - Math.floor(Math.log10(range / 5)))) : 1;
}
