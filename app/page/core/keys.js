/** Keyboard shortcuts of the page. */

/** Keys that controls handle themselves. @type {Record<string, RegExp>} */
const CONTROL_KEYS = {
  select: /^(?!ctrl\+)/,
  'input[type=radio]': /^( |Arrow.*)$/,
  'input[type=range]': /^(Arrow.*|Home|End|Page.*)$/,
  'button, a': /^ $/,
};

/** Key of the command palette, also in text fields. */
const FIND = 'ctrl+k';

/**
 * Calls an action when its key is pressed, except in text fields, in dialogs and in controls that use the key.
 * @param {Record<string, (event: KeyboardEvent) => void>} actions by `KeyboardEvent.key`, with Ctrl or ⌘ as `ctrl+shift+z`
 */
export function bindKeys(actions) {
  document.addEventListener('keydown', (event) => {
    if (event.altKey || event.defaultPrevented) return;
    const key =
      event.ctrlKey || event.metaKey
        ? `ctrl+${event.shiftKey ? 'shift+' : ''}${event.key.toLowerCase()}`
        : event.key;
    if (document.querySelector('dialog[open]') || isHandledBy(event.target, key)) return;
    const action = actions[key];
    if (!action) return;
    event.preventDefault();
    action(event);
  });
  // After a choice with the mouse the shortcuts work again; after a choice with the keyboard the focus stays.
  document.addEventListener('change', ({ target }) => {
    if (!(target instanceof HTMLElement)) return;
    if (target.matches('select, input') && !target.matches(':focus-visible')) target.blur();
  });
}

/**
 * Returns whether an element handles a key itself.
 * @param {EventTarget | null} target
 * @param {string} key
 */
function isHandledBy(target, key) {
  if (!(target instanceof HTMLElement) || key === FIND) return false;
  for (const [selector, pattern] of Object.entries(CONTROL_KEYS))
    if (target.closest(selector)) return pattern.test(key);
  return target.matches('input, textarea, [contenteditable]');
}
