/** The part of the canvas drawing context that the maps use, written as SVG. */

/** @type {Record<string, string>} */
const ANCHORS = { left: 'start', center: 'middle', right: 'end' };
/** @type {Record<string, string>} */
const BASELINES = { top: '0.8em', middle: '0.35em', bottom: '0', alphabetic: '0' };

/** @param {number} value */
const number = (value) => String(Number(value.toFixed(2)));

/** @param {string} text */
const escape = (text) => String(text).replace(/[<>&"]/g, (c) => `&#${c.charCodeAt(0)};`);

/**
 * Writes a colour and its opacity as two attributes, because some programs do not read `rgb(0 0 0 / 0.5)`.
 * @param {string} attribute
 * @param {string} colour
 */
function paint(attribute, colour) {
  const [, red, green, blue, alpha] = /^rgb\((\d+) (\d+) (\d+) \/ ([\d.]+)\)$/.exec(colour) ?? [];
  return red === undefined
    ? `${attribute}="${escape(colour)}"`
    : `${attribute}="rgb(${red},${green},${blue})" ${attribute}-opacity="${alpha}"`;
}

export class SvgContext {
  fillStyle = '#000';
  strokeStyle = '#000';
  lineWidth = 1;
  font = '10px sans-serif';
  textAlign = 'left';
  textBaseline = 'alphabetic';
  /** @type {string[]} */
  #elements = [];
  /** @type {string[]} */
  #path = [];
  /** @type {number[]} */
  #dash = [];
  #openGroups = [0]; // number of open groups for each `save`
  #clips = 0;

  beginPath() {
    this.#path = [];
  }

  /** @param {number} x @param {number} y */
  moveTo(x, y) {
    this.#path.push(`M${number(x)} ${number(y)}`);
  }

  /** @param {number} x @param {number} y */
  lineTo(x, y) {
    this.#path.push(`L${number(x)} ${number(y)}`);
  }

  /** @param {number} x @param {number} y @param {number} width @param {number} height */
  rect(x, y, width, height) {
    this.#path.push(
      `M${number(x)} ${number(y)}h${number(width)}v${number(height)}h${number(-width)}z`,
    );
  }

  /**
   * Adds a full circle; the angles are ignored.
   * @param {number} x
   * @param {number} y
   * @param {number} radius
   * @param {number} _start
   * @param {number} _end
   */
  arc(x, y, radius, _start, _end) {
    const r = number(radius);
    this.#path.push(
      `M${number(x - radius)} ${number(y)}a${r} ${r} 0 1 0 ${number(2 * radius)} 0a${r} ${r} 0 1 0 ${number(-2 * radius)} 0`,
    );
  }

  /**
   * Estimates the width of a text of digits from the size of the font.
   * @param {string} text
   */
  measureText(text) {
    return {
      width: 0.6 * (parseFloat(this.font.match(/[\d.]+(?=px)/)?.[0] ?? '') || 10) * text.length,
    };
  }

  /** @param {number[]} dash */
  setLineDash(dash) {
    this.#dash = dash;
  }

  stroke() {
    const dash = this.#dash.length ? ` stroke-dasharray="${this.#dash.join(' ')}"` : '';
    this.#write(
      `<path d="${this.#path.join('')}" fill="none" ${paint('stroke', this.strokeStyle)} stroke-width="${number(this.lineWidth)}"${dash}/>`,
    );
  }

  fill() {
    this.#write(`<path d="${this.#path.join('')}" ${paint('fill', this.fillStyle)}/>`);
  }

  clip() {
    const id = `clip${this.#clips++}`;
    this.#write(`<clipPath id="${id}"><path d="${this.#path.join('')}"/></clipPath>`);
    this.#openGroup(`clip-path="url(#${id})"`);
  }

  save() {
    this.#openGroups.push(0);
  }

  restore() {
    this.#write('</g>'.repeat(this.#openGroups.pop() ?? 0));
  }

  /** @param {number} x @param {number} y */
  translate(x, y) {
    this.#openGroup(`transform="translate(${number(x)} ${number(y)})"`);
  }

  /** @param {number} radians */
  rotate(radians) {
    this.#openGroup(`transform="rotate(${number((radians * 180) / Math.PI)})"`);
  }

  /** @param {string} text @param {number} x @param {number} y @param {number} [widest] px; a longer text is narrowed */
  fillText(text, x, y, widest = Infinity) {
    const narrowed = this.measureText(text).width > widest;
    const fit = narrowed ? ` textLength="${number(widest)}" lengthAdjust="spacingAndGlyphs"` : '';
    const style = `text-anchor="${ANCHORS[this.textAlign]}" dy="${BASELINES[this.textBaseline]}" style="font: ${escape(this.font)}"`;
    this.#write(
      `<text x="${number(x)}" y="${number(y)}" ${paint('fill', this.fillStyle)} ${style}${fit}>${escape(text)}</text>`,
    );
  }

  /**
   * @param {HTMLCanvasElement} canvas
   * @param {...number} boxes x, y, width and height in the canvas, if not all of it, and in the drawing
   */
  drawImage(canvas, ...boxes) {
    const part = boxes.length > 4 ? boxes.slice(0, 4) : [0, 0, canvas.width, canvas.height];
    const [x, y, width, height] = boxes.slice(-4).map(number);
    const place = `x="${x}" y="${y}" width="${width}" height="${height}" viewBox="${part.map(number).join(' ')}" preserveAspectRatio="none"`;
    const image = `<image width="${canvas.width}" height="${canvas.height}" preserveAspectRatio="none" href="${canvas.toDataURL()}"/>`;
    this.#write(`<svg ${place}>${image}</svg>`);
  }

  /**
   * Returns the drawing as an SVG document.
   * @param {number} width
   * @param {number} height
   */
  document(width, height) {
    const size = `width="${number(width)}" height="${number(height)}" viewBox="0 0 ${number(width)} ${number(height)}"`;
    const closing = '</g>'.repeat(this.#openGroups[0]);
    return `<svg xmlns="http://www.w3.org/2000/svg" ${size}>${this.#elements.join('\n')}${closing}</svg>\n`;
  }

  /** @param {string} attribute */
  #openGroup(attribute) {
    this.#openGroups[this.#openGroups.length - 1] += 1;
    this.#write(`<g ${attribute}>`);
  }

  /** @param {string} text */
  #write(text) {
    this.#elements.push(text);
  }
}
