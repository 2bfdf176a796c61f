/** Measurements for the browser tests and the benchmarks. */

const MAX_LATENCIES = 1000;

export const stats = {
  /** ms from an input to the maps. @type {number[]} */
  scrub: [],
  /** ms from an input to the 3D scene. @type {number[]} */
  scene: [],
  /** The maps received last. @type {{serial?: number, step: number, size: number | undefined} | null} */
  maps: null,
  /** The step that the 3D scene shows. @type {{step: number} | null} */
  drawn: null,
  /** ms from the start of the page until it showed its timeline and its maps. @type {number | null} */
  useful: null,
};

/**
 * Adds a latency to a list and drops the oldest ones.
 * @param {number[]} latencies
 * @param {number} value ms
 */
export function addLatency(latencies, value) {
  latencies.push(value);
  if (latencies.length > MAX_LATENCIES) latencies.shift();
}
