/** Diagram of the modules of a filter: nested boxes, trained ones filled and frozen ones hatched. A click toggles one. */

/** @import { ModuleInfo } from '../types/server.js' */

import { create, createButton } from '../core/dom.js';
import { significant } from '../core/units.js';

/**
 * @typedef {object} Box
 * @property {ModuleInfo} module
 * @property {string[]} parameters names of the parameters within the module
 * @property {HTMLButtonElement} button
 */

/** Names of modules whose outputs decide how measurements are combined: they are drawn after the others. */
const FUSION = /^(weight_model|output)$/;
const MAX_DEPTH = 4; // of a box

export class ModuleDiagram {
  #host;
  #onChange;
  /** @type {Box[]} */
  #boxes = [];
  /** Names of all modules, outer ones first. @type {ModuleInfo[]} */
  #modules = [];
  /** Names of all parameters. @type {string[]} */
  #parameters = [];
  /** Names of the trained parameters. @type {Set<string>} */
  #trained = new Set();

  /**
   * @param {HTMLElement} host
   * @param {() => void} onChange called when a box was toggled
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
    [this.#modules, this.#parameters, this.#boxes] = [modules, parameters, []];
    const outermost = modules.filter(({ depth }) => depth === 1);
    const isFusion = (/** @type {ModuleInfo} */ { name, kind }) =>
      FUSION.test(name) || kind === 'Parameter';
    const columns = [outermost.filter((m) => !isFusion(m)), outermost.filter(isFusion)];
    this.#host.replaceChildren(
      ...columns
        .filter((column) => column.length)
        .map((column) =>
          create('div', { className: 'column' }, ...column.map((module) => this.#box(module))),
        ),
    );
    this.#draw();
  }

  /**
   * Selects the parameters to train.
   * @param {string[]} names
   */
  choose(names) {
    this.#trained = new Set(names);
    this.#draw();
  }

  /** Names of the outermost modules that are trained completely, and of the other trained parameters. */
  get trained() {
    /** @type {string[]} */
    const names = [];
    /** @param {string} name */
    const isCovered = (name) => names.some((other) => other === name || contains(other, name));
    for (const { name } of this.#modules) {
      const within = this.#within(name);
      if (!isCovered(name) && within.every((parameter) => this.#trained.has(parameter)))
        names.push(name);
    }
    return [...names, ...[...this.#trained].filter((name) => !isCovered(name))];
  }

  /** Number of trained parameters, and of all. @returns {[trained: number, total: number]} */
  get count() {
    const leaves = this.#modules.filter(
      ({ name }) => !this.#modules.some((other) => contains(name, other.name)),
    );
    const trained = leaves.filter(({ name }) =>
      this.#within(name).every((parameter) => this.#trained.has(parameter)),
    );
    /** @param {ModuleInfo[]} modules */
    const total = (modules) => modules.reduce((sum, { parameters }) => sum + parameters, 0);
    return [total(trained), total(leaves)];
  }

  /** @param {string} name of a module or a parameter */
  #within(name) {
    return this.#parameters.filter((p) => p === name || contains(name, p));
  }

  /**
   * @param {ModuleInfo} module
   * @param {string} [label]
   * @returns {HTMLElement}
   */
  #box(module, label = lastName(module.name)) {
    const { name, kind, description, parameters } = module;
    const children = this.#children(module);
    // A module with a single part is drawn as one box.
    if (children.length === 1) return this.#box(children[0], label);
    const text = [description || kind, `${parameters.toLocaleString('en')} parameters`];
    const button = createButton('', '', () => this.#toggle(name), {
      role: 'checkbox',
      ariaLabel: `Train ${name}`,
      title: [name, ...text, changeSummary(module)].filter(Boolean).join('\n'),
    });
    button.append(
      create('b', { textContent: label.replaceAll('_', ' ') }),
      create('small', { textContent: shortCount(parameters) }),
    );
    this.#boxes.push({ module, parameters: this.#within(name), button });
    const inside = children.map((child) => this.#box(child));
    const box = create('div', { className: inside.length ? 'module group' : 'module' }, button);
    if (inside.length) box.append(create('div', { className: 'parts' }, ...inside));
    return box;
  }

  /**
   * Returns the parts of a module that are drawn: none of a stack of layers, and those of a list in its place.
   * @param {ModuleInfo} module
   * @returns {ModuleInfo[]}
   */
  #children({ name, depth }) {
    const children = this.#modules.filter(
      (other) => contains(name, other.name) && other.depth === depth + 1,
    );
    if (children.some((child) => /^\d+$/.test(lastName(child.name))) || depth >= MAX_DEPTH)
      return [];
    return children.flatMap((child) =>
      lastName(child.name) === 'by_modality' ? this.#children(child) : [child],
    );
  }

  /** @param {string} name */
  #toggle(name) {
    const parameters = this.#within(name);
    const isTrained = parameters.every((parameter) => this.#trained.has(parameter));
    for (const parameter of parameters) this.#trained[isTrained ? 'delete' : 'add'](parameter);
    this.#draw();
    this.#onChange();
  }

  #draw() {
    for (const { parameters, button } of this.#boxes) {
      const count = parameters.filter((name) => this.#trained.has(name)).length;
      button.ariaChecked = !count ? 'false' : count === parameters.length ? 'true' : 'mixed';
    }
  }
}

/** @param {string} name */
const lastName = (name) => name.split('.').at(-1) ?? '';

/**
 * Returns whether a module contains another module or a parameter.
 * @param {string} module
 * @param {string} name
 */
const contains = (module, name) => name.startsWith(`${module}.`);

/** @param {number} count */
function shortCount(count) {
  if (count < 1000) return String(count);
  return `${(count / 1000).toFixed(count < 9950 ? 1 : 0)} k`;
}

/**
 * Returns how the fine-tuning that wrote the checkpoint changed a module; empty if it did not.
 * @param {ModuleInfo} module
 */
function changeSummary({ gradient, change }) {
  if (gradient === undefined || gradient === null) return '';
  return `gradient ${significant(gradient)}, changed by ${significant(100 * Number(change))} %`;
}
