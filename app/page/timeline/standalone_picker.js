/** The timeline's choice of a standalone filter: the same filter with one modality only, as comparison run. */

/** @import { Store } from '../core/state.js' */
/** @import { Trace } from '../data/trace.js' */

import { element, setOptions } from '../core/dom.js';
import { displayName } from '../core/units.js';

const PREFIX = 'only=';

/**
 * Connects the choice.
 * @param {Store} store
 * @returns {(trace: Trace) => void} offers the modalities of a trace
 */
export function standalonePicker(store) {
  const select = element('#standalone', HTMLSelectElement);
  const update = () => {
    const { against } = store.state;
    select.value = against.startsWith(PREFIX) ? against.slice(PREFIX.length) : '';
  };
  select.addEventListener('change', () =>
    store.set({ against: select.value && PREFIX + select.value }),
  );
  store.when(['against'], update);
  return ({ inputs }) => {
    const options = inputs.map((name) => [name, `${displayName(name)} standalone`]);
    setOptions(select, [['', 'standalone: none'], ...options]);
    select.hidden = !inputs.length;
    update();
  };
}
