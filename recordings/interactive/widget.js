/** Notebook widget of a run (RunWidget), in a shadow tree so that styles of the notebook and of the run do not mix. */

import { Viewer } from './viewer.js';

/**
 * @typedef {object} Model
 * @property {(name: string) => any} get
 * @property {(name: string, value: unknown) => void} set
 * @property {() => void} save_changes
 * @property {(event: string, listener: () => void) => void} on
 * @property {(event: string, listener: () => void) => void} off
 */

/** @param {{model: Model, el: HTMLElement}} arguments_ */
function render({ model, el }) {
  const root = el.attachShadow({ mode: 'open' });
  root.innerHTML = `<style>${model.get('_style')}</style>${model.get('_body')}`;
  const viewer = new Viewer(root, JSON.parse(model.get('_run')), (step) => {
    model.set('step', step);
    model.save_changes();
  });
  viewer.frame.tabIndex = 0;
  viewer.frame.addEventListener('keydown', (event) => viewer.press(event));
  const follow = () => {
    if (model.get('step') !== viewer.step) viewer.move(model.get('step'));
  };
  model.on('change:step', follow);
  viewer.move(model.get('step'));
  return () => {
    clearInterval(viewer.timer);
    model.off('change:step', follow);
  };
}

export default { render };
