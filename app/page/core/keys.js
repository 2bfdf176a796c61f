/** What the keys do, anywhere on the page but in a field. */

const OWN = { 'select': /^(?!ctrl\+)/, 'input[type=radio]': /^( |Arrow.*)$/, 'input[type=range]': /^(Arrow.*|Home|End|Page.*)$/, 'button, a': /^ $/ };

/** @param {Record<string, (event: KeyboardEvent) => void>} actions by key, as KeyboardEvent.key names it, those with Ctrl or ⌘ as `ctrl+shift+z`. */
export function keys(actions) {
  document.addEventListener('keydown', (event) => {
    if (event.altKey || event.defaultPrevented) return;
    const key = event.ctrlKey || event.metaKey ? `ctrl+${event.shiftKey ? 'shift+' : ''}${event.key.toLowerCase()}` : event.key;
    if (document.querySelector('dialog[open]') || belongsTo(event.target, key)) return;
    const action = actions[key];
    if (!action) return;
    event.preventDefault();
    action(event);
  });
  // Who chose with the mouse goes on with the page's keys; who chose with the keyboard stays where they are.
  document.addEventListener('change', ({ target }) => {
    if (target.matches('select, input') && !target.matches(':focus-visible')) target.blur();
  });
}

/** Whether an element does something of its own with a key. */
function belongsTo(target, key) {
  if (!(target instanceof HTMLElement)) return false;
  for (const [selector, pattern] of Object.entries(OWN)) if (target.closest(selector)) return pattern.test(key);
  return target.matches('input, textarea, [contenteditable]');
}
