/** From the wire's m and rad to the page's cm and degrees. */

export const SHOWN = { m: { unit: 'cm', scale: 100 }, rad: { unit: '°', scale: 180 / Math.PI } };

/** @param {string} name as in the state: hinge_x. */
export const spoken = (name) => name.replaceAll('_', ' ');

/** A line as a sentence. */
export const sentence = (line) => `${line[0].toUpperCase()}${line.slice(1)}${/[.!?]$/.test(line) ? '' : '.'}`;

/** A number with a true minus sign and a fixed number of digits; a dash where there is none. */
export function fixed(value, digits = 1) {
  if (value === null || value === undefined || !Number.isFinite(value)) return '–';
  const text = value.toFixed(digits);
  return /^-[0.]*$/.test(text) ? text.slice(1) : text.replace('-', '−');
}

/** As `fixed`, with the sign always written. */
export const signed = (value, digits = 1) => (value > 0 && Number(value.toFixed(digits)) > 0 ? '+' : '') + fixed(value, digits);

/** A number with three significant digits, an integer whole; a dash where there is none. */
export function significant(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return '–';
  const size = Math.abs(value);
  if (Number.isInteger(value) && size < 1e6) return fixed(value, 0);
  if (size >= 1e6 || size < 1e-4) return value.toExponential(2).replaceAll('-', '−').replace('e+', 'e');
  return fixed(value, Math.max(0, 2 - Math.floor(Math.log10(size))));
}

export const percent = (share) => (Number.isFinite(share) ? `${Math.round(100 * share)} %` : '–');

/** The difference of two angles in degrees, in -180..180. */
export const wrapped = (degrees) => degrees - 360 * Math.round(degrees / 360);

export function bytes(count) {
  const [size, unit] = [[1e9, 'GB'], [1e6, 'MB']].find(([least]) => count >= least) ?? [];
  return size ? `${(count / size).toFixed(1)} ${unit}` : `${Math.round(count / 1e3)} kB`;
}
