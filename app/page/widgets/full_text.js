/** Complete text of lines that are cut off where the room is short: on focus; their tooltips have it as well. */

import { create } from '../core/dom.js';

const GAP = 4; // px

/**
 * Shows the complete text of an element below it while it has the focus and is cut off.
 * @param {HTMLElement} element whose title is its complete text
 */
export function showFullText(element) {
  const box = create('div', { className: 'full-text', popover: 'manual', ariaHidden: 'true' });
  element.tabIndex = 0;
  element.after(box);
  const update = () => {
    const isOpen = element.matches(':focus-visible') && isCut(element);
    box.togglePopover(isOpen);
    if (!isOpen) return;
    box.textContent = element.title;
    const { left, bottom, width } = element.getBoundingClientRect();
    box.style.top = `${bottom + GAP}px`;
    box.style.left = `${left}px`;
    box.style.width = `${width}px`;
  };
  for (const type of ['focus', 'blur']) element.addEventListener(type, update);
  element.addEventListener('keydown', ({ key }) => key === 'Escape' && box.hidePopover());
  new MutationObserver(() => document.activeElement === element && update()).observe(element, {
    childList: true,
    characterData: true,
    subtree: true,
  });
}

/**
 * Returns whether the text of an element or of one of its children has no room.
 * @param {Element} element
 * @returns {boolean}
 */
function isCut(element) {
  const { scrollHeight, clientHeight, scrollWidth, clientWidth } = element;
  const isBlock = clientHeight > 0; // inline elements have no size of their own
  if (isBlock && (scrollHeight > clientHeight + 1 || scrollWidth > clientWidth + 1)) return true;
  return [...element.children].some(isCut);
}
