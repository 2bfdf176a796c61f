/** Charts of channels: readings of vector sensors, residuals, controls, and innovations of the measurements. */

/** @import { Channel } from '../data/channels.js' */
/** @import { Trace } from '../data/trace.js' */
/** @import { Series, Track } from './chart.js' */

import { displayName } from '../core/units.js';
import { INNOVATION, READINGS, RESIDUAL } from '../data/channels.js';
import { digitsOf } from './digits.js';

const CONTROL = 'control';

/**
 * Returns the keys and labels of the charts of readings, residuals and controls, and of the innovation of each of several
 * modalities.
 * @param {Trace} trace
 * @returns {[key: string, label: string][]}
 */
export function channelOptions(trace) {
  const measured = trace.channels.columns(INNOVATION);
  return [
    ...optionsOf(measured.length > 1 ? measured : [], INNOVATION, 'innovation of'),
    ...optionsOf(trace.channels.columns(READINGS), READINGS, 'readings of'),
    ...optionsOf(trace.channels.columns(RESIDUAL), RESIDUAL, 'residual of'),
  ];
}

/**
 * @param {string[]} columns
 * @param {string} start of their names
 * @param {string} noun
 * @returns {[key: string, label: string][]}
 */
const optionsOf = (columns, start, noun) =>
  columns.map((column) => {
    const name = column.slice(start.length);
    return [column, column === READINGS + CONTROL ? 'controls' : `${noun} ${displayName(name)}`];
  });

/**
 * Returns whether a chart is one of channels: of readings, of residuals, or of the innovation of one modality.
 * @param {string} key
 */
export const isOfChannels = (key) =>
  [READINGS, RESIDUAL, INNOVATION].some((start) => key.startsWith(start));

/**
 * Returns the chart of the readings or residuals of a sensor, of the controls, or of the innovation of a modality; null if the trace
 * has none.
 * @param {Trace} trace
 * @param {string} key column
 * @returns {Track | null}
 */
export function channelTrack(trace, key) {
  if (key.startsWith(INNOVATION)) return innovationsTrack(trace, [key]);
  const channels = trace.channels.of(key);
  if (!channels.length) return null;
  const sensor = key.slice(key.indexOf('/') + 1);
  const [quantity, help] = quantityOf(key, displayName(sensor));
  return {
    title: quantity[0].toUpperCase() + quantity.slice(1),
    help,
    ...linesOf(channels.map((channel) => ({ ...channel, name: ownName(channel.name, sensor) }))),
  };
}

/**
 * Returns the title and the explanation of the chart of a column.
 * @param {string} key
 * @param {string} sensor
 * @returns {[title: string, help: string]}
 */
function quantityOf(key, sensor) {
  if (key === READINGS + CONTROL) return ['Controls', 'Controls, as the filter received them'];
  return key.startsWith(RESIDUAL)
    ? [`${sensor} minus truth`, `Readings of ${sensor} minus the true state: bias, noise, outliers`]
    : [
        `${sensor} readings`,
        `Readings of ${sensor}, as the filter received them; gaps: steps without a reading`,
      ];
}

/**
 * Returns the chart of innovations that the filter reports, a line for each modality and channel; null without any.
 * @param {Trace} trace
 * @param {string[]} [columns] of modalities, by default all
 * @returns {Track | null}
 */
export function innovationsTrack(trace, columns = trace.channels.columns(INNOVATION)) {
  const channels = columns.flatMap((column) => measuredChannels(trace, column));
  if (!channels.length) return null;
  const only = columns.length === 1 ? `, ${displayName(columns[0].slice(INNOVATION.length))}` : '';
  return {
    title: `Innovation${only}`,
    help: 'Measurement minus predicted measurement of each channel, reported by the filter. For a consistent filter 95 % are within the ±2σ band.',
    ...linesOf(channels, columns.length === 1),
  };
}

/**
 * Returns the channels with values of the innovation of a modality. Their names contain those of its sensors, or else
 * that of the modality.
 * @param {Trace} trace
 * @param {string} column
 */
export function measuredChannels(trace, column) {
  const modality = column.slice(INNOVATION.length);
  return trace.channels.innovation(column).map((channel) => ({
    ...channel,
    name: channel.name.startsWith('channel ') ? `${modality} ${channel.name}` : channel.name,
  }));
}

/**
 * Returns the lines of channels. The unit of the chart is that of all channels; different ones are in the names.
 * @param {Channel[]} channels
 * @param {boolean} [alike] whether channels without a unit have similar values
 * @returns {Pick<Track, 'unit' | 'series' | 'digits' | 'ofModalities'>}
 */
function linesOf(channels, alike = true) {
  const units = new Set(channels.map(({ unit }) => unit));
  const [unit] = units.size === 1 ? units : [''];
  /** @type {Series[]} */
  const series = channels.map(({ name, unit: own, values, sigma }, line) => ({
    name: displayName(own && own !== unit ? `${name} (${own})` : name),
    values,
    sigma,
    aroundZero: Boolean(sigma),
    line,
  }));
  const digits = unit || (alike && units.size === 1) ? digitsOf(series) : undefined;
  return { unit, series, digits, ofModalities: true };
}

/**
 * Returns the name of a channel without that of its sensor, which is in the title: x of force x.
 * @param {string} name
 * @param {string} sensor
 */
const ownName = (name, sensor) =>
  name.startsWith(`${sensor} `) ? name.slice(sensor.length + 1) : name;
