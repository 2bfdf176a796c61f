/** Sensor faults: presets, and a dialog for any other fault injection as text (docs/data.md). */

const OTHER = 'other';

/** The sheet in which any faults can be written. A faults that the server refuses changes nothing but the sheet. */
export class FaultSheet {
  #sheet;
  #text;
  #wrong;
  #asker = null;

  /** @param {HTMLDialogElement} sheet @param {import('../data/api.js').Fault[]} faults */
  constructor(sheet, faults) {
    this.#sheet = sheet;
    [this.#text, this.#wrong] = ['input', '.wrong'].map((part) => sheet.querySelector(part));
    this.#text.addEventListener('input', () => this.#tell(''));
    sheet.querySelector('tbody').replaceChildren(...faults.map((fault) => row(fault, this.#text)));
    sheet.querySelector('form').addEventListener('submit', (event) => this.#take(event));
  }

  /**
   * @param {string} faults to begin with @param {(faults: string) => Promise<unknown>} check raises what is wrong with one
   * @param {(faults: string) => void} choose is given the one that is applied
   */
  ask(faults, check, choose) {
    this.#asker = { check, choose };
    this.#text.value = faults;
    this.#tell('');
    this.#sheet.showModal();
    this.#text.focus();
  }

  async #take(event) {
    if (event.submitter?.value === 'cancel') return;
    event.preventDefault();
    const faults = this.#text.value.trim();
    try {
      await this.#asker.check(faults);
    } catch (error) {
      return this.#tell(error.message);
    }
    this.#asker.choose(faults);
    this.#sheet.close();
  }

  #tell(line) {
    this.#wrong.textContent = line;
  }
}

/**
 * Select element with the fault presets; its last entry opens the dialog.
 * @param {HTMLSelectElement} select @param {FaultSheet} sheet
 * @param {object} of @param {string} of.none what no faults is called @param {() => string} of.chosen
 * @param {(faults: string) => void} of.choose @param {(faults: string) => Promise<unknown>} of.check
 * @returns {(ready: {name: string, faults: string}[]) => void} shows those that are ready, and the chosen one
 */
export function faultPicker(select, sheet, { none, chosen, choose, check }) {
  let ready = [];
  const show = () => {
    const faults = chosen();
    const own = faults && !ready.some((r) => r.faults === faults) ? [{ name: faults, faults }] : [];
    const all = [{ name: none, faults: '' }, ...ready, ...own, { name: 'other …', faults: OTHER }];
    select.replaceChildren(...all.map((r) => new Option(r.name, r.faults)));
    [select.value, select.disabled, select.title] = [
      faults,
      false,
      `How the sensors are broken${faults && `: ${faults}`}`,
    ];
  };
  const take = (faults) => (choose(faults), show());
  select.addEventListener('change', () => {
    if (select.value !== OTHER) return take(select.value);
    select.value = chosen();
    sheet.ask(chosen(), check, take);
  });
  return (list) => ((ready = list), show());
}

/** A fault in the sheet's list; its button adds it to the text. */
function row({ fault, meaning, parameters }, text) {
  const own = parameters.slice(0, -2); // all have the last two, from and to
  const line = document.createElement('tr');
  const button = document.createElement('button');
  [button.type, button.className, button.textContent, button.title] = [
    'button',
    'text quiet',
    fault,
    'Add it',
  ];
  button.addEventListener('click', () => {
    const first = parameters[0].default ?? '';
    text.value = [text.value.trim(), `${fault}=${first}`].filter(Boolean).join(',');
    text.dispatchEvent(new Event('input'));
    text.focus();
  });
  const cells = [
    button,
    own.map((p) => (p.default === null ? p.name : `${p.name}=${p.default}`)).join(' '),
    meaning,
  ];
  for (const cell of cells) line.insertCell().append(cell);
  line.cells[1].title = own.map((p) => `${p.name}: ${p.meaning} (${p.unit})`).join('\n');
  return line;
}
