/** Disables every control that changes something, on a read-only server. */

const REASON = 'Read-only server: nothing can be computed, written or changed';
const CONTROLS =
  '#save, #report, #jobs li > button, .doing > button, #finetune .start, #finetune .decide > button, #study .cells > button';

/**
 * Disables the controls below an element, also when panels add or enable them later.
 * @param {HTMLElement} root
 */
export function disableChanges(root) {
  const disable = () => {
    for (const button of root.querySelectorAll(CONTROLS)) {
      if (!(button instanceof HTMLButtonElement)) continue;
      if (!button.disabled) button.disabled = true;
      if (button.title !== REASON) button.title = REASON;
    }
  };
  disable();
  new MutationObserver(disable).observe(root, {
    subtree: true,
    childList: true,
    attributes: true,
    attributeFilter: ['disabled', 'title'],
  });
}
