/** The tabs on the left of the page. */

/** @import { Store } from './state.js' */

import { element, html } from './dom.js';
import { TABS } from './state.js';

/** Tabs without the run: they fill the page, unless the user has chosen other sizes. */
const FULL_TABS = ['finetune', 'experiments', 'study', 'recordings'];
/** Tabs that use the width of maps and current step too. */
const WIDE_TABS = ['rerun', ...FULL_TABS];

/**
 * @param {Store} store
 * @returns {(tab: string) => void} displays a tab
 */
export function tabBar(store) {
  const buttons = TABS.map((name) => element(`#tab-${name}`, HTMLButtonElement));
  buttons.forEach((button, i) => {
    button.addEventListener('click', () => store.set({ tab: TABS[i] }));
    button.addEventListener('keydown', (event) => {
      if (event.key !== 'ArrowLeft' && event.key !== 'ArrowRight') return;
      event.stopPropagation();
      const next = (i + (event.key === 'ArrowRight' ? 1 : TABS.length - 1)) % TABS.length;
      store.set({ tab: TABS[next] });
      buttons[next].focus();
    });
  });
  return (selected) => {
    const { classList } = document.documentElement;
    classList.toggle('wide-tab', WIDE_TABS.includes(selected));
    classList.toggle('full-tab', FULL_TABS.includes(selected));
    TABS.forEach((name, i) => {
      buttons[i].ariaSelected = String(name === selected);
      buttons[i].tabIndex = name === selected ? 0 : -1;
      html(`#${name}`).hidden = name !== selected;
    });
    scrollTo(buttons[TABS.indexOf(selected)]);
  };
}

/**
 * Scrolls a bar that is too narrow for all tabs. `scrollIntoView` would start the tab key's order at the tab.
 * @param {HTMLElement} button
 */
function scrollTo(button) {
  const bar = /** @type {HTMLElement} */ (button.parentElement);
  const [outer, inner] = [bar.getBoundingClientRect(), button.getBoundingClientRect()];
  if (inner.left < outer.left) bar.scrollLeft += inner.left - outer.left;
  else if (inner.right > outer.right) bar.scrollLeft += inner.right - outer.right;
}
