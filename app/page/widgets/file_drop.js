/** Drag and drop of files onto a panel. */

/**
 * Accepts files that are dropped on a panel.
 * @param {HTMLElement} host
 * @param {HTMLElement} overlay displayed while files are dragged over the panel
 * @param {(files: File[]) => void} add
 */
export function acceptDrops(host, overlay, add) {
  let depth = 0; // a drag enters and leaves each element on its way
  /** @param {number} value */
  const setDepth = (value) => {
    depth = Math.max(0, value);
    overlay.hidden = depth === 0;
  };
  /**
   * @param {'dragenter' | 'dragover' | 'dragleave' | 'drop'} kind
   * @param {(files: File[]) => void} action
   */
  const listen = (kind, action) =>
    host.addEventListener(kind, (event) => {
      if (!event.dataTransfer?.types.includes('Files')) return;
      event.preventDefault();
      action([...event.dataTransfer.files]);
    });
  listen('dragenter', () => setDepth(depth + 1));
  listen('dragover', () => {});
  listen('dragleave', () => setDepth(depth - 1));
  listen('drop', (files) => {
    setDepth(0);
    add(files);
  });
}
