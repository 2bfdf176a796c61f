/** Colours of filters: by fusion rule, as in the figures of studies (recordings/study_figures.py). */

/** @type {Record<string, string>} */
const COLOURS = {
  crossmodal: '--fused',
  information: '--spare-4',
  unimodal: '--spare-2',
  feature: '--spare-1',
  lstm: '--spare-0',
  transformer: '--spare-3',
  image: '--image',
  haptics: '--haptics',
};
/** Of filters of other names, in turn. */
const OTHERS = ['--ink', '--contact', '--truth', '--spare-5', '--spare-6', '--spare-7'];

/** @param {string} filter */
const fusionRule = (filter) => filter.replace(/-?(ekf|ukf|pf)$/, '');

/**
 * Returns the kind of estimator that a filter's name ends with, or an empty text.
 * @param {string} filter
 * @param {string[]} kinds
 */
export const estimatorOf = (filter, kinds) =>
  kinds.find((kind) => `-${filter}`.endsWith(`-${kind}`)) ?? '';

/**
 * Returns the property with the colour of a filter.
 * @param {string} filter
 * @param {string[]} [filters] all displayed filters: those of other names have different colours
 */
export function colourOf(filter, filters = [filter]) {
  const colour = COLOURS[fusionRule(filter)];
  if (colour) return colour;
  const others = [...new Set(filters.map(fusionRule))].filter((name) => !(name in COLOURS));
  return OTHERS[Math.max(0, others.indexOf(fusionRule(filter))) % OTHERS.length];
}
