/** Tree of the modules of a filter; a checkbox per module selects which ones are trained. */

/** @import { ModuleInfo } from '../types/server.js' */

import { create } from '../core/dom.js';
import { significant } from '../core/units.js';

/**
 * @typedef {object} ModuleRow
 * @property {ModuleInfo} module
 * @property {string[]} parameters names of the parameters within the module
 * @property {boolean} isLeaf whether it contains no other module
 * @property {HTMLLIElement} row
 * @property {HTMLInputElement} checkbox
 * @property {HTMLButtonElement} toggle
 */

export class ModuleTree {
  #host;
  #onChange;
  /** @type {ModuleRow[]} */
  #rows = [];
  /** Names of the collapsed modules. @type {Set<string>} */
  #collapsed = new Set();
  /** Names of the trained parameters. @type {Set<string>} */
  #trained = new Set();

  /**
   * @param {HTMLElement} host a list
   * @param {() => void} onChange called when a checkbox was changed
   */
  constructor(host, onChange) {
    this.#host = host;
    this.#onChange = onChange;
  }

  /**
   * @param {ModuleInfo[]} modules
   * @param {string[]} parameters names of all parameters
   */
  show(modules, parameters) {
    this.#rows = modules.map((module) => {
      const within = parameters.filter((p) => p === module.name || contains(module.name, p));
      const isLeaf = !modules.some(({ name }) => contains(module.name, name));
      return this.#row(module, within, isLeaf);
    });
    this.#host.replaceChildren(...this.#rows.map(({ row }) => row));
    this.#draw();
  }

  /**
   * Selects the parameters to train, and expands the modules that are trained in part.
   * @param {string[]} names
   */
  choose(names) {
    this.#trained = new Set(names);
    const others = this.#rows.filter((row) => !this.#isPartlyTrained(row));
    this.#collapsed = new Set(others.map(({ module }) => module.name));
    this.#draw();
  }

  /** Names of the outermost modules that are trained completely, and of the other trained parameters. */
  get trained() {
    /** @type {string[]} */
    const names = [];
    /** @param {string} name */
    const isCovered = (name) => names.some((other) => other === name || contains(other, name));
    for (const { module, parameters } of this.#rows)
      if (!isCovered(module.name) && this.#trainedCount(parameters) === parameters.length)
        names.push(module.name);
    return [...names, ...[...this.#trained].filter((name) => !isCovered(name))];
  }

  /** Number of trained parameters, and of all. @returns {[trained: number, total: number]} */
  get count() {
    const leaves = this.#rows.filter(({ isLeaf }) => isLeaf);
    const trained = leaves.filter(
      (row) => this.#trainedCount(row.parameters) === row.parameters.length,
    );
    /** @param {ModuleRow[]} rows */
    const total = (rows) => rows.reduce((sum, { module }) => sum + module.parameters, 0);
    return [total(trained), total(leaves)];
  }

  /** @param {string[]} parameters */
  #trainedCount(parameters) {
    return parameters.filter((name) => this.#trained.has(name)).length;
  }

  /** @param {ModuleRow} row */
  #isPartlyTrained({ parameters }) {
    const count = this.#trainedCount(parameters);
    return count > 0 && count < parameters.length;
  }

  /**
   * @param {ModuleInfo} module
   * @param {string[]} parameters
   * @param {boolean} isLeaf
   * @returns {ModuleRow}
   */
  #row(module, parameters, isLeaf) {
    const toggle = create('button', { type: 'button', className: 'quiet toggle' });
    const checkbox = create('input', { type: 'checkbox', ariaLabel: `Train ${module.name}` });
    const name = create('b', { textContent: module.name.split('.').at(-1) ?? '' });
    const title = `${module.name} (${module.kind})`;
    const text = [changeSummary(module), module.description || module.kind];
    const description = text.filter(Boolean).join(' · ');
    const row = create(
      'li',
      {},
      toggle,
      create('label', { title }, checkbox, ' ', name),
      create('span', { className: 'number' }, module.parameters.toLocaleString('en')),
      create('span', { className: 'description', title: description }, description),
    );
    row.style.setProperty('--depth', String(module.depth - 1));
    toggle.style.visibility = isLeaf ? 'hidden' : '';
    toggle.addEventListener('click', () => {
      if (!this.#collapsed.delete(module.name)) this.#collapsed.add(module.name);
      this.#draw();
    });
    checkbox.addEventListener('change', () => {
      for (const parameter of parameters)
        this.#trained[checkbox.checked ? 'add' : 'delete'](parameter);
      this.#draw();
      this.#onChange();
    });
    return { module, parameters, isLeaf, row, checkbox, toggle };
  }

  #draw() {
    for (const item of this.#rows) {
      const { module, parameters, row, checkbox, toggle } = item;
      checkbox.checked = this.#trainedCount(parameters) === parameters.length;
      checkbox.indeterminate = this.#isPartlyTrained(item);
      row.hidden = [...this.#collapsed].some((name) => contains(name, module.name));
      const isCollapsed = this.#collapsed.has(module.name);
      toggle.textContent = isCollapsed ? '▸' : '▾';
      toggle.ariaLabel = `${isCollapsed ? 'Expand' : 'Collapse'} ${module.name}`;
      toggle.ariaExpanded = String(!isCollapsed);
    }
  }
}

/**
 * Returns whether a module contains another module or a parameter.
 * @param {string} module
 * @param {string} name
 */
const contains = (module, name) => name.startsWith(`${module}.`);

/**
 * Returns how the fine-tuning that wrote the checkpoint changed a module; empty if it did not.
 * @param {ModuleInfo} module
 */
function changeSummary({ gradient, change }) {
  if (gradient === undefined || gradient === null) return '';
  return `gradient ${significant(gradient)}, changed by ${significant(100 * Number(change))} %`;
}
