/** Access to the clipboard. */

/**
 * Copies a text. Browsers without the clipboard interface, and pages that are not served securely, use a selection.
 * @param {string} text
 * @returns {Promise<boolean>} whether the text was copied
 */
export async function copyText(text) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    const area = document.createElement('textarea');
    area.value = text;
    document.body.append(area);
    area.select();
    const success = document.execCommand('copy');
    area.remove();
    return success;
  }
}
