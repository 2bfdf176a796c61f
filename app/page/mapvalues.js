/** The likelihood maps as they arrive (docs/api.md), and what is made of their cells: shades, ranges, regions, differences. */

/**
 * @typedef {object} Maps of one step
 * @property {number} serial @property {number} step @property {number} size cells a side, S @property {number | null} angle rad
 * @property {string[]} layers L names @property {number} half_width m @property {number[]} centre m @property {number[]} truth
 * @property {number[]} estimate @property {number[]} log_max @property {number[]} log_range nats below the peak that are told apart
 * @property {number[][]} peak m, offsets @property {number[] | null} effector m
 * @property {Record<string, any>} numbers of `MapNumbers`, by layer
 * @property {Float32Array} positions M x 2 m, of particles @property {Float32Array[]} weights (M,) by layer
 * @property {Uint16Array[]} cells S x S by layer; row 0 is the smallest y offset
 */

const STEPS = 65535;
const DEEPEST = 64; // nats: a layer with this range has cells that are as deep or deeper
const decoder = new TextDecoder();

/** @param {ArrayBuffer} buffer @returns {Maps} */
export function readMaps(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const maps = JSON.parse(decoder.decode(new Uint8Array(buffer, 4, length)));
  let at = 4 + Math.ceil(length / 4) * 4;
  const take = (Kind, count) => {
    const array = new Kind(buffer, at, count);
    at += array.byteLength;
    return array;
  };
  const { particles, layers, size } = maps;
  maps.positions = take(Float32Array, 2 * particles);
  maps.weights = layers.map(() => take(Float32Array, particles));
  maps.cells = layers.map(() => take(Uint16Array, size * size));
  return maps;
}
