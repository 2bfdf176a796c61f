/** How the sensors are broken: recipes that are ready to be picked, and any other in words (docs/data.md). */

import { check } from './api.js';

const OTHER = 'other';

/**
 * The picker, and the sheet behind its last entry. A recipe that the server refuses changes nothing but the sheet.
 * @param {HTMLSelectElement} select @param {HTMLDialogElement} sheet
 * @param {import('./api.js').Catalog} catalog @param {import('./state.js').Store} store
 * @returns {() => void} shows the state's recipe
 */
export function recipes(select, sheet, catalog, store) {
  const [text, wrong, list] = ['input', '.wrong', 'tbody'].map((part) => sheet.querySelector(part));
  const tell = (line) => (wrong.textContent = line);
  select.addEventListener('change', () => {
    if (select.value !== OTHER) return store.set({ recipe: select.value });
    select.value = text.value = store.state.recipe;
    tell('');
    sheet.showModal();
    text.focus();
  });
  text.addEventListener('input', () => tell(''));
  list.replaceChildren(...catalog.faults.map((fault) => row(fault, text)));
  sheet.querySelector('form').addEventListener('submit', async (event) => {
    if (event.submitter?.value === 'cancel') return;
    event.preventDefault();
    const recipe = text.value.trim();
    try {
      await check({ ...store.state, recipe });
    } catch (error) {
      return tell(error.message);
    }
    store.set({ recipe });
    sheet.close();
  });
  return () => {
    const { task, recipe } = store.state;
    const ready = catalog.tasks.find((t) => t.name === task).recipes;
    const own = recipe && !ready.some((r) => r.recipe === recipe) ? [{ name: recipe, recipe }] : [];
    const all = [{ name: 'as recorded', recipe: '' }, ...ready, ...own, { name: 'other …', recipe: OTHER }];
    select.replaceChildren(...all.map((r) => new Option(r.name, r.recipe)));
    [select.value, select.disabled, select.title] = [recipe, false, `How the sensors are broken${recipe && `: ${recipe}`}`];
  };
}

/** A fault in the sheet's list; its button adds it to the text. */
function row({ fault, meaning, parameters }, text) {
  const own = parameters.slice(0, -2); // all have the last two, from and to
  const line = document.createElement('tr');
  const button = document.createElement('button');
  [button.type, button.className, button.textContent, button.title] = ['button', 'text quiet', fault, 'Add it'];
  button.addEventListener('click', () => {
    const first = parameters[0].default ?? '';
    text.value = [text.value.trim(), `${fault}=${first}`].filter(Boolean).join(',');
    text.dispatchEvent(new Event('input'));
    text.focus();
  });
  const cells = [button, own.map((p) => (p.default === null ? p.name : `${p.name}=${p.default}`)).join(' '), meaning];
  for (const cell of cells) line.insertCell().append(cell);
  line.cells[1].title = own.map((p) => `${p.name}: ${p.meaning} (${p.unit})`).join('\n');
  return line;
}
