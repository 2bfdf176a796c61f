/** Saved layouts: sizes of the panels and a tab, in a menu. */

/** @import { Sizes } from './pane_sizes.js' */

import { create, createButton, html, openBelow } from './dom.js';

/** @typedef {{name: string, help: string, sizes: Sizes, tab: string}} Layout */

/** The first has the default sizes. @type {Layout[]} */
export const LAYOUTS = [
  { name: 'Explore', help: 'scene, maps and timeline', sizes: {}, tab: 'scene' },
  {
    name: 'Maps',
    help: 'large likelihood maps',
    sizes: { side: 0.75, step: 0 },
    tab: 'diagnosis',
  },
  {
    name: 'Rerun',
    help: 'the viewer over the full width',
    sizes: { side: 0, timeline: 0.25 },
    tab: 'rerun',
  },
  {
    name: 'Compare',
    help: 'two runs, and large charts',
    sizes: { side: 0.35, timeline: 0.5, step: 0 },
    tab: 'compare',
  },
];

/**
 * Fills the menu of layouts.
 * @param {HTMLElement} menu a popover
 * @param {HTMLElement} button that opens it
 * @param {(layout: Layout) => void} apply
 */
export function layoutMenu(menu, button, apply) {
  const rows = LAYOUTS.map((layout) => {
    const row = createButton('', '', () => {
      apply(layout);
      menu.hidePopover();
    });
    const help = create('small', { textContent: layout.help });
    row.append(create('b', { textContent: layout.name }), help);
    return row;
  });
  html('.rows', menu).append(...rows);
  openBelow(menu, button);
}
