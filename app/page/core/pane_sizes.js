/** Sizes of the panels as shares of the space that they divide. */

/** @typedef {'side' | 'timeline' | 'step'} Pane side: maps and current step */
/** @typedef {Partial<Record<Pane, number>>} Sizes panes without a size have their default; 0: collapsed */

/** Smallest and largest share of each pane. @type {Record<Pane, [min: number, max: number]>} */
export const LIMITS = { side: [0.25, 0.75], timeline: [0.16, 0.7], step: [0.15, 0.7] };

/**
 * Returns the nearest permitted share; below half of the smallest one a pane collapses.
 * @param {Pane} pane
 * @param {number} share
 */
export function permittedShare(pane, share) {
  const [min, max] = LIMITS[pane];
  return share < min / 2 ? 0 : Math.min(Math.max(share, min), max);
}

/**
 * Returns the sizes in a text; unknown panes and invalid shares are dropped.
 * @param {string | null} text
 * @returns {Sizes}
 */
export function parseSizes(text) {
  /** @type {unknown} */
  let values;
  try {
    values = JSON.parse(text ?? '{}');
  } catch {
    return {};
  }
  const entries = Object.entries(values ?? {}).filter(
    ([name, share]) => name in LIMITS && Number.isFinite(share),
  );
  return Object.fromEntries(
    entries.map(([name, share]) => [name, permittedShare(/** @type {Pane} */ (name), share)]),
  );
}

/**
 * Returns the share of a pane after a key on its separator; null for other keys.
 * @param {Pane} pane
 * @param {number} share
 * @param {string} key `KeyboardEvent.key`
 * @param {boolean} isVertical whether the separator is vertical
 * @param {boolean} isLarge whether the step is large
 */
export function shareAfterKey(pane, share, key, isVertical, isLarge) {
  const [min, max] = LIMITS[pane];
  // The pane lies to the right of its separator, or below it.
  const [grow, shrink] = isVertical ? ['ArrowLeft', 'ArrowRight'] : ['ArrowUp', 'ArrowDown'];
  const step = isLarge ? 0.1 : 0.02;
  if (key === grow) return share ? Math.min(share + step, max) : min;
  if (key === shrink) return share - step < min ? (share > min ? min : 0) : share - step;
  if (key === 'Home') return min;
  return key === 'End' ? max : null;
}
