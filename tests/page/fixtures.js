/** Objects for the tests, in the format of the server. */

import { Trace } from '../../app/page/data/trace.js';

/** @type {import('../../app/page/types/server.js').Task} */
export const TASK = {
  name: 'door',
  components: [
    { name: 'hinge_x', unit: 'm', display_unit: 'cm', scale: 100 },
    { name: 'hinge_y', unit: 'm', display_unit: 'cm', scale: 100 },
    { name: 'angle', unit: 'rad', display_unit: 'deg', scale: 180 / Math.PI },
  ],
  modalities: ['image', 'haptics'],
  dt: 0.1,
  map: { components: ['hinge_x', 'hinge_y'], half_width: 0.2 },
  main: { name: 'position', key: 'position_cm', unit: 'cm', scale: 100, indices: [0, 1] },
  fault_presets: [],
  filters: ['crossmodal-pf', 'crossmodal-ekf'].map((name) => ({
    name,
    kind: name.slice(-3),
    checkpoint_hash: '',
    training: {},
    metrics: {},
  })),
  data: [
    {
      name: 'door',
      first: 9,
      first_step: 2,
      count: 2,
      episodes: [8, 9].map((index) => ({
        index,
        steps: 4,
        policy: 'scripted',
        split: 'test',
        seed: 0,
        contact_fraction: 0.5,
      })),
    },
  ],
};

/** @type {import('../../app/page/types/server.js').Catalog} */
export const CATALOG = {
  version: '0',
  read_only: false,
  examples: [],
  faults: [],
  tasks: [TASK],
  problems: [],
};

/** @typedef {import('../../app/page/types/server.js').TraceHeader['columns'][number]['channels']} Channels */
/** @typedef {Record<string, {shape: number[], values: number[], channels?: Channels}>} Arrays */

/**
 * Encodes columns end to end, as the server does.
 * @param {Arrays} arrays
 */
export function encodeColumns(arrays) {
  let offset = 0;
  const columns = Object.entries(arrays).map(([name, { shape, values, channels }]) => {
    const column = { name, shape, offset, ...(channels && { channels }) };
    offset += 4 * values.length;
    return column;
  });
  const values = Object.values(arrays).flatMap((array) => array.values);
  return { columns, buffer: Float32Array.from(values).buffer };
}

/**
 * Creates a trace.
 * @param {Arrays} arrays
 * @param {object} [header]
 * @param {ArrayBuffer | null} [images]
 */
export function makeTrace(arrays, header = {}, images = null) {
  const { columns, buffer } = encodeColumns(arrays);
  const selection = { task: 'door', filter: 'ekf', data: 'door', episode: 9, faults: '' };
  return new Trace(
    TASK,
    selection,
    /** @type {import('../../app/page/types/server.js').TraceHeader} */ ({
      steps: arrays.truth.shape[0],
      dt: 0.1,
      kind: 'ekf',
      components: TASK.components,
      modalities: TASK.modalities,
      groups: ['contact'],
      settings: {},
      sensors: [],
      nees_bounds: null,
      no_maps: null,
      missing_quantities: {},
      columns,
      ...header,
    }),
    buffer,
    images,
  );
}

/** Columns of a filter that fuses two modalities, over two steps. */
export const FUSION = {
  truth: { shape: [2, 3], values: [0, 0, 0, 0.1, 0.2, 3.1] },
  estimate_mean: { shape: [2, 3], values: [0.03, 0.04, 0, 0.1, 0.2, -3.1] },
  estimate_sigma: { shape: [2, 3], values: [0.01, 0.02, 0.1, 0.03, 0.04, 0.1] },
  modality_mean: {
    shape: [2, 2, 3],
    values: [0, 0, 0, 0.3, 0, 0, 0.1, 0.2, 3.1, 0.1, 0.3, 3.1],
  },
  weights: {
    shape: [2, 2, 3],
    values: [0.9, 0.9, 0.5, 0.1, 0.1, 0.5, 0.2, 0.2, 0.2, 0.8, 0.8, 0.8],
  },
  effective_weights: { shape: [2, 2, 3], values: [0.7, 0.6, 0.5, 0.3, 0.4, 0.5, 1, 1, 1, 0, 0, 0] },
  contact: { shape: [2], values: [0, 1] },
};

/** A row of the Experiments tab. */
export const ROW = {
  name: 'run-1',
  filter: 'crossmodal-ekf',
  task: 'door',
  faults: 'blackout=0.4',
  episodes: 3,
  steps: 90,
  error: 0.5,
  unit: 'cm',
  components: { hinge_x_cm: 0.3, hinge_y_cm: 0.4, angle_deg: 25 },
  nees: 2.5,
  nll: -3.25,
  coverage95: 0.9,
  worst: 1.5,
  worst_episode: 2,
  worst_step: 40,
  worst_time: 4,
  checkpoint: 'a'.repeat(64),
  data: 'b'.repeat(64),
  training: '{}',
  provenance: '{"lr": 0.001}',
  catalog_name: null,
  data_name: null,
  data_file: 'door.h5',
};

/** Checkpoints with provenance of several forms, as JSON that is stored with escapes. */
export const RECORDED = [
  { seed: 0, lr: '1e-3', operator: 'S\u00f8ren', 'model.weird key': 'a b', debug: true, note: 'x' },
  { seed: 1, lr: 3e-4, operator: 'Mu\u0308ller', 'model.weird key': 'c', debug: false },
  { seed: 10, lr: 'auto', operator: 'M\u00fcller', RMSE: 'own' },
].map((provenance, i) => ({
  ...ROW,
  name: `run-${i}`,
  error: 3 + i,
  checkpoint: String(i).repeat(64),
  provenance: JSON.stringify(provenance).replace(
    /[^\x20-\x7e]/g,
    (letter) => `\\u${letter.charCodeAt(0).toString(16).padStart(4, '0')}`,
  ),
}));
