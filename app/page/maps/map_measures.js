/** The table of the measures of likelihood maps, in the menu of the maps. */

/** @import { Maps } from './map_values.js' */

import { columnHeading, create, fillTable, html } from '../core/dom.js';
import { displayName } from '../core/units.js';
import { layerMeasures, measureColumns, pairwiseMeasures } from './map_summary.js';

/**
 * Fills the table, and the line with the differences between modalities.
 * @param {HTMLElement} menu
 * @param {Maps} maps
 * @param {string[]} layers that are displayed
 * @param {boolean} world whether the axes show world coordinates
 */
export function showMeasures(menu, maps, layers, world) {
  const headings = measureColumns(maps).map((title) => columnHeading(title));
  const rows = layers.map((name, layer) =>
    create(
      'tr',
      {},
      create('th', { scope: 'row', textContent: displayName(name) }),
      ...layerMeasures(maps, layer, world).cells.map((textContent) =>
        create('td', { textContent }),
      ),
    ),
  );
  fillTable(menu, [create('td'), ...headings], rows);
  html('#maps-pairs', menu).textContent = pairwiseMeasures(maps);
}
