/** Maximises a panel: it fills the page below the header until Escape, its button or a double click on its bar. */

import { createButton, html } from './dom.js';

/** Adds the buttons to the bars of all panels. */
export function bindMaximise() {
  for (const panel of panels()) {
    const bar = html('.bar', panel);
    bar.append(createButton('text quiet maximise', '', () => toggle(panel)));
    bar.addEventListener('dblclick', ({ target }) => {
      const isControl =
        target instanceof Element && target.closest('button, select, input, label, a');
      if (!isControl) toggle(panel);
    });
    label(panel);
  }
  document.addEventListener('keydown', (event) => {
    const panel = document.querySelector('.panel.maximised');
    if (event.key !== 'Escape' || event.defaultPrevented || !(panel instanceof HTMLElement)) return;
    if (!document.querySelector('dialog[open], :popover-open')) toggle(panel);
  });
}

/** Toggles the panel below the pointer, the one with the focus, or the first one. */
export function toggleMaximised() {
  const maximised = document.querySelector('.panel.maximised');
  const chosen =
    maximised ??
    document.querySelector('.panel:hover') ??
    document.activeElement?.closest('.panel');
  toggle(chosen instanceof HTMLElement ? chosen : panels()[0]);
}

/** @returns {HTMLElement[]} */
const panels = () =>
  [...document.querySelectorAll('main > .panel, body > .panel')].filter(
    (panel) => panel instanceof HTMLElement,
  );

/** @param {HTMLElement} panel */
function toggle(panel) {
  const isMaximised = panel.classList.toggle('maximised');
  document.body.classList.toggle('maximised', isMaximised);
  for (const other of panels()) {
    if (other !== panel) other.classList.remove('maximised');
    other.inert = isMaximised && other !== panel;
    label(other);
  }
}

/** @param {HTMLElement} panel */
function label(panel) {
  const [text, name] = panel.classList.contains('maximised') ? ['⤡', 'Restore'] : ['⤢', 'Maximise'];
  const button = html('.maximise', panel);
  button.textContent = text;
  button.ariaLabel = `${name}: ${panel.ariaLabel}`;
  button.title = `${name} (x)`;
}
