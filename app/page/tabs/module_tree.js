/** The modules of a filter as a tree whose parts are thawed and frozen by check boxes, one for each at any depth. */

import { significant } from '../core/units.js';

export class ModuleTree {
  #host;
  #changed;
  #rows = []; // {module, row, box, within: names of its parameters}
  #closed = new Set();
  #all = [];
  #trained = new Set();

  /** @param {HTMLElement} host @param {() => void} changed by hand */
  constructor(host, changed) {
    [this.#host, this.#changed] = [host, changed];
  }

  /** @param {{name: string, kind: string, description: string, parameters: number, depth: number}[]} modules @param {string[]} parameters names of all */
  show(modules, parameters) {
    this.#all = parameters;
    const inside = (name) => parameters.filter((p) => p === name || p.startsWith(`${name}.`));
    this.#rows = modules.map((module) =>
      this.#row(
        module,
        inside(module.name),
        modules.some((m) => m.name.startsWith(`${module.name}.`)),
      ),
    );
    this.#host.replaceChildren(...this.#rows.map(({ row }) => row));
    this.#draw();
  }

  /** Chooses these parameters and no others, and opens what is trained in part. @param {string[]} names */
  choose(names) {
    this.#trained = new Set(names);
    const partly = ({ within }) =>
      within.some((p) => this.#trained.has(p)) && !within.every((p) => this.#trained.has(p));
    this.#closed = new Set(
      this.#rows.filter((row) => !partly(row)).map(({ module }) => module.name),
    );
    this.#draw();
  }

  /** Names of what is trained: of parts that are trained as a whole, the outermost. @returns {string[]} */
  get trained() {
    const names = [];
    const told = (p) => names.some((name) => p === name || p.startsWith(`${name}.`));
    for (const { module, within } of this.#rows)
      if (!told(module.name) && within.every((p) => this.#trained.has(p))) names.push(module.name);
    return [...names, ...[...this.#trained].filter((p) => !told(p))];
  }

  /** How many of how many numbers are trained. @returns {[number, number]} */
  get count() {
    const leaves = this.#rows.filter(
      ({ module }) => !this.#rows.some((other) => other.module.name.startsWith(`${module.name}.`)),
    );
    const size = ({ module, within }) =>
      within.every((p) => this.#trained.has(p)) ? module.parameters : 0;
    return [
      leaves.reduce((sum, row) => sum + size(row), 0),
      leaves.reduce((sum, { module }) => sum + module.parameters, 0),
    ];
  }

  #row(module, within, deeper) {
    const row = document.createElement('li');
    row.style.setProperty('--depth', String(module.depth - 1));
    row.innerHTML = `<button type="button" class="quiet twist"></button><label><input type="checkbox"> <b></b></label><span class="number"></span><span class="description"></span>`;
    const [twist, label, size, description] = row.children;
    const box = label.firstElementChild;
    label.querySelector('b').textContent = module.name.split('.').at(-1);
    [label.title, size.textContent] = [
      `${module.name} (${module.kind})`,
      module.parameters.toLocaleString('en'),
    ];
    description.textContent = description.title = [
      history(module),
      module.description || module.kind,
    ]
      .filter(Boolean)
      .join(' · ');
    box.setAttribute('aria-label', `Train ${module.name}`);
    twist.style.visibility = deeper ? '' : 'hidden';
    twist.addEventListener('click', () => {
      if (!this.#closed.delete(module.name)) this.#closed.add(module.name);
      this.#draw();
    });
    box.addEventListener('change', () => {
      for (const p of within) this.#trained[box.checked ? 'add' : 'delete'](p);
      this.#draw();
      this.#changed();
    });
    return { module, row, box, twist, within };
  }

  #draw() {
    for (const { module, row, box, twist, within } of this.#rows) {
      const count = within.filter((p) => this.#trained.has(p)).length;
      [box.checked, box.indeterminate] = [
        count === within.length,
        count > 0 && count < within.length,
      ];
      row.hidden = [...this.#closed].some((name) => module.name.startsWith(`${name}.`));
      const closed = this.#closed.has(module.name);
      twist.textContent = closed ? '▸' : '▾';
      twist.setAttribute('aria-label', `${closed ? 'Show' : 'Hide'} what is in ${module.name}`);
      twist.setAttribute('aria-expanded', String(!closed));
    }
  }
}

/** What the fine-tuning that made the filter did to a module; nothing where there was none, or it was frozen. */
function history({ gradient, change }) {
  return gradient === undefined
    ? ''
    : `gradient ${significant(gradient)}, changed by ${significant(100 * change)} %`;
}
