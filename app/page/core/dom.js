/** Typed access to elements of the page. */

/**
 * Returns the first element that matches a selector. Throws if there is none, or if it has another type.
 * @template {Element} T
 * @param {string} selector
 * @param {new () => T} type such as HTMLButtonElement
 * @param {ParentNode} [root]
 * @returns {T}
 */
export function element(selector, type, root = document) {
  const node = root.querySelector(selector);
  if (node instanceof type) return node;
  throw new Error(`The page has no ${type.name} “${selector}”.`);
}

/**
 * Returns the first HTML element that matches a selector.
 * @param {string} selector
 * @param {ParentNode} [root]
 */
export const html = (selector, root = document) => element(selector, HTMLElement, root);

/**
 * Creates an element with properties and children.
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} tag
 * @param {Partial<Omit<HTMLElementTagNameMap[K], 'style'>>} [properties]
 * @param {...(Node | string)} children
 * @returns {HTMLElementTagNameMap[K]}
 */
export function create(tag, properties = {}, ...children) {
  const node = document.createElement(tag);
  Object.assign(node, properties);
  node.append(...children);
  return node;
}

/**
 * Replaces the options of a select, and enables it.
 * @param {HTMLSelectElement} select
 * @param {(string | number)[][] | Record<string, string>} options [value, text], or texts by value
 * @param {string | number} [selected] value, the first one by default
 */
export function setOptions(select, options, selected) {
  const entries = Array.isArray(options) ? options : Object.entries(options);
  select.replaceChildren(
    ...entries.map(([value, text]) => new Option(String(text), String(value))),
  );
  if (selected !== undefined) select.value = String(selected);
  select.disabled = false;
}

/**
 * Creates a button.
 * @param {string} className
 * @param {string} textContent
 * @param {(event: MouseEvent) => void} press
 * @param {Partial<Omit<HTMLButtonElement, 'style'>>} [properties]
 */
export function createButton(className, textContent, press, properties) {
  const button = create('button', { type: 'button', className, textContent, ...properties });
  button.addEventListener('click', press);
  return button;
}

/**
 * Replaces the head and the rows of a table.
 * @param {HTMLElement} table
 * @param {Node[]} headings
 * @param {Node[]} rows
 */
export function fillTable(table, headings, rows) {
  html('thead', table).replaceChildren(create('tr', {}, ...headings));
  html('tbody', table).replaceChildren(...rows);
}

/**
 * Creates the heading of a column.
 * @param {string} textContent
 * @param {Partial<Omit<HTMLTableCellElement, 'style'>>} [properties]
 */
export const columnHeading = (textContent, properties) =>
  create('th', { scope: 'col', textContent, ...properties });

/**
 * Returns the element with the focus if it is in a host.
 * @param {HTMLElement} host
 */
export function focusedIn(host) {
  const { activeElement } = document;
  return activeElement instanceof HTMLElement && host.contains(activeElement)
    ? activeElement
    : null;
}

/**
 * Lets a popover open below a button, with the same right edge.
 * @param {HTMLElement} popover
 * @param {HTMLElement} button
 */
export function openBelow(popover, button) {
  popover.addEventListener('beforetoggle', () => {
    const { bottom, right } = button.getBoundingClientRect();
    popover.style.top = `${bottom + 4}px`;
    popover.style.right = `${Math.max(0, document.documentElement.clientWidth - right)}px`;
  });
}

/**
 * Returns the drawing context of a canvas.
 * @param {HTMLCanvasElement} canvas
 * @param {CanvasRenderingContext2DSettings} [settings]
 * @returns {CanvasRenderingContext2D}
 */
export function context2d(canvas, settings) {
  const context = canvas.getContext('2d', settings);
  if (!context) throw new Error('The browser cannot draw on a canvas.');
  return context;
}

/**
 * Paints all pixels of a canvas.
 * @param {HTMLCanvasElement} canvas
 * @param {ArrayLike<number>} colours with the bytes R, G, B, A in memory
 * @param {CanvasRenderingContext2D} [context]
 */
export function paintPixels(canvas, colours, context = context2d(canvas)) {
  const image = new ImageData(canvas.width, canvas.height);
  new Uint32Array(image.data.buffer).set(colours);
  context.putImageData(image, 0, 0);
}

/**
 * Opens a socket for binary messages.
 * @param {string} path
 */
export function openSocket(path) {
  const url = new URL(path, location.href);
  url.protocol = url.protocol.replace('http', 'ws');
  const socket = new WebSocket(url);
  socket.binaryType = 'arraybuffer';
  return socket;
}

/** @param {number} ms */
export const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

/**
 * Returns the message of anything thrown.
 * @param {unknown} error
 */
export const messageOf = (error) => (error instanceof Error ? error.message : String(error));

/**
 * Returns whether a request was aborted by its signal.
 * @param {unknown} error
 */
export const isAbort = (error) => error instanceof Error && error.name === 'AbortError';

const SVG = 'http://www.w3.org/2000/svg';

/**
 * @template {keyof SVGElementTagNameMap} K
 * @param {K} tag
 * @param {Record<string, string | number>} attributes
 * @param {...(Node | string)} children
 * @returns {SVGElementTagNameMap[K]}
 */
export function svgElement(tag, attributes, ...children) {
  const node = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes))
    node.setAttribute(name, typeof value === 'number' ? String(Number(value.toFixed(2))) : value);
  node.append(...children);
  return node;
}

/** Returns whether the page scrolls, as in a low window; the wheel then scrolls it, whatever is under the pointer. */
export const pageScrolls = () => document.documentElement.scrollHeight > innerHeight;
