/** The strokes that the maps are drawn with, as on a canvas's context, but written as SVG. */

const EASED = { left: 'start', center: 'middle', right: 'end' };
const RAISED = { top: '0.8em', middle: '0.35em', bottom: '0', alphabetic: '0' };
const number = (value) => String(Number(value.toFixed(2)));
/** A colour as an attribute and its opacity: not every program reads `rgb(0 0 0 / 0.5)`. */
function paint(kind, style) {
  const [, red, green, blue, alpha] = /^rgb\((\d+) (\d+) (\d+) \/ ([\d.]+)\)$/.exec(style) ?? [];
  return red === undefined ? `${kind}="${escaped(style)}"` : `${kind}="rgb(${red},${green},${blue})" ${kind}-opacity="${alpha}"`;
}
const escaped = (text) => String(text).replace(/[<>&"]/g, (c) => `&#${c.charCodeAt(0)};`);

export class SvgPen {
  fillStyle = '#000';
  strokeStyle = '#000';
  lineWidth = 1;
  font = '10px sans-serif';
  textAlign = 'left';
  textBaseline = 'alphabetic';
  #written = [];
  #path = [];
  #dash = [];
  #open = [0]; // groups to be closed, by save
  #clips = 0;

  beginPath() {
    this.#path = [];
  }

  moveTo(x, y) {
    this.#path.push(`M${number(x)} ${number(y)}`);
  }

  lineTo(x, y) {
    this.#path.push(`L${number(x)} ${number(y)}`);
  }

  rect(x, y, width, height) {
    this.#path.push(`M${number(x)} ${number(y)}h${number(width)}v${number(height)}h${number(-width)}z`);
  }

  /** Whole circles only. */
  arc(x, y, radius) {
    const r = number(radius);
    this.#path.push(`M${number(x - radius)} ${number(y)}a${r} ${r} 0 1 0 ${number(2 * radius)} 0a${r} ${r} 0 1 0 ${number(-2 * radius)} 0`);
  }

  setLineDash(dash) {
    this.#dash = dash;
  }

  stroke() {
    const dash = this.#dash.length ? ` stroke-dasharray="${this.#dash.join(' ')}"` : '';
    this.#write(`<path d="${this.#path.join('')}" fill="none" ${paint('stroke', this.strokeStyle)} stroke-width="${number(this.lineWidth)}"${dash}/>`);
  }

  fill() {
    this.#write(`<path d="${this.#path.join('')}" ${paint('fill', this.fillStyle)}/>`);
  }

  clip() {
    const id = `clip${this.#clips++}`;
    this.#write(`<clipPath id="${id}"><path d="${this.#path.join('')}"/></clipPath>`);
    this.#begin(`clip-path="url(#${id})"`);
  }

  save() {
    this.#open.push(0);
  }

  restore() {
    this.#write('</g>'.repeat(this.#open.pop()));
  }

  translate(x, y) {
    this.#begin(`transform="translate(${number(x)} ${number(y)})"`);
  }

  rotate(radians) {
    this.#begin(`transform="rotate(${number((radians * 180) / Math.PI)})"`);
  }

  fillText(text, x, y) {
    const style = `text-anchor="${EASED[this.textAlign]}" dy="${RAISED[this.textBaseline]}" style="font: ${escaped(this.font)}"`;
    this.#write(`<text x="${number(x)}" y="${number(y)}" ${paint('fill', this.fillStyle)} ${style}>${escaped(text)}</text>`);
  }

  /** @param {HTMLCanvasElement} canvas @param {number[]} numbers the part that is shown, all of it by default, and where: x, y, width, height of both */
  drawImage(canvas, ...numbers) {
    const part = numbers.length > 4 ? numbers.slice(0, 4) : [0, 0, canvas.width, canvas.height];
    const [x, y, width, height] = numbers.slice(-4).map(number);
    const place = `x="${x}" y="${y}" width="${width}" height="${height}" viewBox="${part.map(number).join(' ')}" preserveAspectRatio="none"`;
    const image = `<image width="${canvas.width}" height="${canvas.height}" preserveAspectRatio="none" href="${canvas.toDataURL()}"/>`;
    this.#write(`<svg ${place}>${image}</svg>`);
  }

  /** All that was drawn, as a document. */
  document(width, height) {
    const size = `width="${number(width)}" height="${number(height)}" viewBox="0 0 ${number(width)} ${number(height)}"`;
    return `<svg xmlns="http://www.w3.org/2000/svg" ${size}>${this.#written.join('\n')}${'</g>'.repeat(this.#open[0])}</svg>\n`;
  }

  #begin(attribute) {
    this.#open[this.#open.length - 1] += 1;
    this.#write(`<g ${attribute}>`);
  }

  #write(element) {
    this.#written.push(element);
  }
}
