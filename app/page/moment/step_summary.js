/** One line that says what the numbers of a step amount to: is the belief off, does it know, and whom does it follow? */

import { fixed, percent, spoken } from '../core/units.js';

const NEAR = { good: 1, else: 0.2 }; // cm: two errors closer than this are called alike, by whether the larger is expected;
const ALIKE = 0.8; // and those of which the smaller is this share of the larger, or more
const SURE = 2; // standard deviations within which an error is what the filter expects
const LEADS = 0.6; // share from which one modality is said to lead
const FEW = 0.05; // of the particles

/**
 * @param {import('../data/trace.js').Trace} trace @param {number} step @param {number} component whose shares count
 * @returns {{tone: 'good' | 'warn' | 'bad' | 'none', text: string}}
 */
export function reading(trace, step, component) {
  const error = trace.error('fused', 'position')[step];
  const [tone, judged] = trace.knows(step) ? judge(trace, step) : ['none'];
  const said = [judged ? `${trace.fuses ? 'Fused belief' : 'The estimate'} is ${fixed(error, 1)} cm off; ${judged}.` : 'The true state is not known.'];

  const [best, leader] = [closest(trace, step), leading(trace, step, component)];
  const blind = (leader?.name === 'image' && trace.black[step] && 'the picture is black') || (leader?.name === 'haptics' && !trace.contact[step] && 'there is no contact to feel');
  const better = leader && best && best.name !== leader.name && best.error < Math.min(error - (NEAR[tone] ?? NEAR.else), ALIKE * error) && `${best.name} alone is ${fixed(best.error, 1)} cm off`;
  const of = trace.weightWidth > 1 ? ` in ${spoken(trace.components[component].name)}` : '';
  const though = [blind, better].filter(Boolean).join(' and ');
  if (leader && (leader.share >= LEADS || better)) {
    said.push(`It follows ${leader.name} (${percent(leader.share)}${of})${though && `, though ${though}`}.`);
  }
  if (trace.black[step] && leader?.name !== 'image') said.push('The picture is black.');
  const particles = trace.particles?.[step];
  const count = trace.header.settings?.particles;
  if (particles && count && particles < FEW * count) said.push(`${fixed(particles, 0)} of ${count} particles carry the weight.`);
  return { tone, text: said.join(' ') };
}

/** How good the belief is by its own measure. */
function judge(trace, step) {
  const surprise = trace.surprise(step);
  if (!surprise) return ['none', 'how sure it is, this filter does not say'];
  const [sigmas, worst] = surprise;
  const [tone, verdict] = sigmas <= SURE ? ['good', 'within what it expects'] : sigmas <= 2 * SURE ? ['warn', 'more than it expects'] : ['bad', 'overconfident'];
  return [tone, `worst in ${spoken(worst)}, ${fixed(sigmas, 1)}σ: ${verdict}`];
}

function closest(trace, step) {
  const each = (trace.has('modality_mean') ? trace.modalities : []).map((name) => ({ name, error: trace.error(name, 'position')[step] }));
  return each.sort((a, b) => a.error - b.error)[0];
}

function leading(trace, step, component) {
  const each = trace.modalities.map((name) => ({ name, share: trace.weight('acting', name, component)?.[step] }));
  return each.filter((m) => m.share !== undefined).sort((a, b) => b.share - a.share)[0];
}
