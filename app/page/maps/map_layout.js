/** Size and arrangement of the likelihood maps in their panel, and their extent. */

/** @import { Maps } from './map_values.js' */

import { MARGIN } from './draw_map.js';

const MIN_SIDE = 60; // px
const MAX_COLUMNS = 4; // of one row, before two rows are tried
const USEFUL_SIDE = 52; // px; more than four maps are not smaller: their area is scrolled instead
export const CLOSE_UP = 4; // zoom while all maps of the run fit into it

/**
 * Returns the largest square of a map that fits, and the number of maps in a row: all, or half of more than four. More
 * than four maps that would be too small get as many rows as their useful size needs, which exceed the height.
 * @param {number} count of maps
 * @param {number} width px of the area of all maps
 * @param {number} height px
 * @param {number} head px, height of the title of a map
 */
export function mapLayout(count, width, height, head) {
  const layouts = [1, ...(count > MAX_COLUMNS ? [2] : [])].map((rows) => {
    const columns = Math.ceil(count / rows);
    const margins = MARGIN.left + (columns - 1) * MARGIN.gap + columns * MARGIN.right;
    const vertical = height / rows - MARGIN.bottom - MARGIN.top - head;
    return { columns, side: Math.floor(Math.min((width - margins) / columns, vertical)) };
  });
  const largest = layouts.reduce((best, layout) => (layout.side > best.side ? layout : best));
  if (count > MAX_COLUMNS && largest.side < USEFUL_SIDE) {
    const slot = USEFUL_SIDE + MARGIN.gap + MARGIN.right;
    const fitting = Math.floor((width - MARGIN.left + MARGIN.gap) / slot);
    const columns = Math.min(Math.max(fitting, 1), count);
    const margins = MARGIN.left + (columns - 1) * MARGIN.gap + columns * MARGIN.right;
    const vertical = height - MARGIN.bottom - MARGIN.top - head; // one row in view
    const side = Math.floor(Math.min((width - margins) / columns, vertical));
    return { columns, side: Math.max(USEFUL_SIDE, side) };
  }
  return { ...largest, side: Math.max(MIN_SIDE, largest.side) };
}

/** @param {number} count of maps; whether they may need two rows */
export const isMany = (count) => count > MAX_COLUMNS;

/**
 * Returns whether peaks and 95 % regions, approximated by ellipses, fit into the close-up.
 * @param {Pick<Maps, 'axes' | 'peak' | 'numbers'>} maps
 */
export function fitsCloseUp({ axes, peak, numbers }) {
  const [halfX, halfY] = axes.map(({ half_width: half }) => half);
  if (axes.length === 1)
    return peak.every(
      ([offset], layer) => Math.abs(offset) + numbers.area95[layer] / 2 <= halfX / CLOSE_UP,
    );
  return peak.every((offset, layer) => {
    const area = numbers.area95[layer] / (halfX * halfY);
    const radius = Math.sqrt((area / Math.PI) * (numbers.elongation[layer] ?? 1));
    const farthest = Math.max(Math.abs(offset[0]) / halfX, Math.abs(offset[1]) / halfY);
    return farthest + radius <= 1 / CLOSE_UP;
  });
}
