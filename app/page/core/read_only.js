/** On a server that only shows: what would change something cannot be pressed, and says why. */

const REASON = 'This server only shows: nothing can be computed, written or changed here';
const CHANGES = '#save, #report, #jobs li > button, .doing > button, #finetune .start, #finetune .decide > button, #study .cells > button';

/** From now on. Panels make and free such buttons as they like; they are held again. @param {HTMLElement} root */
export function hold(root) {
  const again = () => {
    for (const button of root.querySelectorAll(CHANGES)) {
      if (!button.disabled) button.disabled = true;
      if (button.title !== REASON) button.title = REASON;
    }
  };
  again();
  new MutationObserver(again).observe(root, { subtree: true, childList: true, attributes: true, attributeFilter: ['disabled', 'title'] });
}
