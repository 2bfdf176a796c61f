import assert from 'node:assert/strict';
import { test } from 'node:test';

import './browser.js';
import {
  divergence,
  finding,
  largest,
  largestErrorStep,
  outageFinding,
} from '../../app/page/step/finding.js';
import { largestError } from '../../app/page/tabs/diagnosis_cause.js';
import { STEPS as TOUR, placeBeside } from '../../app/page/widgets/tour.js';

const STEPS = 20;

/** @param {(step: number) => number} value */
const series = (value) => Float32Array.from({ length: STEPS }, (_, t) => value(t));

/**
 * A run whose camera is dark from step 8 to `last`, in contact from `contact` on.
 * @param {number} last
 * @param {number} [contact]
 */
const run = (last, contact = 5) =>
  /** @type {any} */ ({
    task: { main: { name: 'position' } },
    mainUnit: 'cm',
    steps: STEPS,
    modalities: ['image', 'haptics'],
    components: [{ name: 'x' }, { name: 'hinge_x' }],
    header: { first_counted: 0 },
    stepLabel: (/** @type {number} */ step) => `step ${step}`,
    weightWidth: 1,
    fuses: true,
    has: () => false,
    updateSize: () => undefined,
    hasTruth: () => true,
    largestDeviation: (/** @type {number} */ t) => ({ sigmas: t < 8 ? 1 : 5, component: 'x' }),
    blackout: series((t) => Number(t >= 8 && t <= last)),
    contact: series((t) => Number(t >= contact)),
    weight: () => series((t) => (t >= 8 && t <= last ? 0.9 : 0.25)),
    error: () => series((t) => (t === 10 ? 1.23 : 0.5)),
  });

/** @type {any} */
const HEALTHY = { state: 'healthy', headline: 'Healthy: all is normal', causes: [] };
/** @type {any} */
const FAULT = {
  state: 'fault',
  masked: false,
  headline: 'Image frozen from step 31',
  causes: [
    {
      probability: 0.9,
      steps: [31, 100],
      evidence: [{ text: 'share of repeated images is 0.7', step: 33 }],
    },
  ],
};

test('the finding describes the outage in contact, with weights, error and its end', () => {
  assert.deepEqual(outageFinding(run(14), 0), {
    headline:
      'The camera goes dark at step 8, in contact; haptics takes over until the image returns at step 15.',
    evidence:
      'The mean effective weight of haptics rises from 25 % before to 90 % in the outage; the position error rises from 0.5 cm to 1.2 cm.',
    step: 8,
  });
  const steady = outageFinding({ ...run(14), error: () => series(() => 0.57) }, 0);
  assert.match(steady?.evidence ?? '', /; the position error stays below 0\.6 cm\.$/);
  assert.match(outageFinding(run(STEPS - 1), 0)?.headline ?? '', /takes over to the end\.$/);
});

test('no modality takes over whose weight stays low', () => {
  const weak = { ...run(14), weight: () => series((t) => (t >= 8 ? 0.4 : 0.25)) };
  const result = outageFinding(weak, 0);
  assert.match(result?.headline ?? '', /in contact, until the image returns at step 15\.$/);
  assert.match(result?.evidence ?? '', /rises from 25 % before to 40 % in the outage/);
});

test('a weight that does not react to an outage stays, although the image is lost', () => {
  const [low, high] = [0.5, 0.98].map((weight) => {
    const constant = { ...run(14), weight: () => series(() => weight) };
    return outageFinding(constant, 0)?.evidence ?? '';
  });
  assert.match(low, /weight of haptics stays at 50 %, although the image is lost;/);
  assert.match(high, /weight of haptics stays at 98 %;/);
  const slight = { ...run(14), weight: () => series((t) => (t >= 8 ? 0.77 : 0.75)) };
  assert.match(outageFinding(slight, 0)?.headline ?? '', /in contact, until the image returns/);
});

test('an outage of the camera is no finding of a filter without it', () => {
  assert.equal(outageFinding({ ...run(14), modalities: ['haptics'] }, 0), null);
  assert.notEqual(outageFinding({ ...run(14), modalities: ['image+haptics'] }, 0), null);
});

test('short outages and those in free motion are no finding', () => {
  assert.equal(outageFinding(run(11), 0), null);
  assert.equal(outageFinding(run(14, 9), 0), null);
});

test('an injected fault that the diagnosis does not name comes before an outage', () => {
  const frozen = {
    ...run(14),
    header: { faults: 'image_frozen=10' },
    faultLabel: 'injected: image frozen',
    faulty: series((t) => Number(t >= 10)),
    error: () => series((t) => (t >= 10 ? 2 : 0.5)),
  };
  const result = finding(frozen, 0, HEALTHY);
  assert.equal(result.headline, 'Injected: image frozen, from step 10.');
  assert.equal(
    result.evidence,
    'The diagnosis does not name it. Mean position error 0.50 cm before, 2.00 cm from then on.',
  );
  assert.deepEqual([result.step, result.tone], [10, 'warn']);
  assert.equal(finding(frozen, 0, FAULT).headline, 'Image frozen from step 31.');
  const part = { ...frozen, faulty: series((t) => Number(t >= 10 && t < 15)) };
  assert.match(finding(part, 0, HEALTHY).headline, /from step 10 to step 14\.$/);
  assert.match(finding(part, 0, HEALTHY).evidence, /2\.00 cm in these steps\./);
  const always = finding({ ...frozen, faulty: series(() => 1) }, 0, HEALTHY);
  assert.equal(always.headline, 'Injected: image frozen, in all steps.');
  assert.match(always.evidence, /^The diagnosis does not name it\. Largest error at step 10\./);
});

test('a fault comes first, then the outage, then the largest error', () => {
  const fault = finding(run(14), 0, FAULT);
  assert.deepEqual(fault, {
    tone: 'bad',
    headline: 'Image frozen from step 31.',
    evidence:
      'Largest position error 1.23 cm at step 10, 5.0σ in x. Share of repeated images is 0.7.',
    step: 33,
    component: undefined,
  });
  const recovered = { error: 0.3, low: null, high: null, nll: 1, measure: 'hinge x' };
  const confirmed = finding(run(14), 0, {
    ...FAULT,
    causes: [
      {
        ...FAULT.causes[0],
        recovered,
        steps: null,
        evidence: [{ text: 'share of repeated images is 0.7', step: null }],
      },
    ],
  });
  assert.match(
    confirmed.evidence,
    /σ in x\. Undoing it removes 30 % of the hinge x error\. Share of/,
  );
  const rises = finding({ ...run(14), error: () => series((t) => (t < 8 ? 0.5 : 2)) }, 0, {
    ...FAULT,
    causes: [{ ...FAULT.causes[0], steps: [8, STEPS] }],
  });
  assert.match(
    rises.evidence,
    /^Mean position error 0\.50 cm before, 2\.00 cm from then on\. Share/,
  );
  assert.deepEqual([confirmed.component, confirmed.step], ['hinge_x', 10], 'the largest error');
  assert.equal(finding(run(14), 0, { ...FAULT, masked: true }).tone, 'warn');
  const unknown = finding(run(14), 0, { ...FAULT, state: 'unsure', causes: [] });
  assert.deepEqual([unknown.tone, unknown.step], ['warn', 10]);
  assert.match(unknown.evidence, /^Largest error at step 10\. /, 'no cause has evidence');
  const diffuse = {
    ...FAULT,
    state: 'unsure',
    causes: [{ ...FAULT.causes[0], probability: 0.03 }],
  };
  assert.deepEqual(finding(run(14), 0, diffuse), unknown, 'no cause stands out');
  const accurate = { ...run(14), largestDeviation: () => ({ sigmas: 1, component: 'x' }) };
  assert.equal(finding(accurate, 0, HEALTHY).tone, 'good');
  assert.equal(finding(accurate, 0, { ...HEALTHY, miscalibrated: true }).tone, 'warn');
  assert.equal(finding(run(14), 0, HEALTHY).tone, 'warn', 'overconfident, as its healthy record');
  assert.equal(finding(run(14), 0, HEALTHY).step, 8);
  const elsewhere = { ...run(14), error: () => series((t) => (t === 16 ? 2 : 0.5)) };
  assert.match(
    finding(elsewhere, 0, HEALTHY).headline,
    /^No fault found, but the filter is overconfident at step 16\.$/,
  );
  assert.equal(finding(elsewhere, 0, HEALTHY).step, 16, 'a failure after the outage');
  const before = { ...run(14), largestDeviation: () => ({ sigmas: 5, component: 'x' }) };
  assert.match(finding(before, 0, HEALTHY).headline, /^No fault found/, 'it failed before');
  const plain = finding(run(11), 0, null);
  assert.equal(plain.headline, 'Largest error at step 10.');
  assert.match(plain.evidence, /error 1\.23 cm, 5\.0σ in x: overconfident/);
  assert.deepEqual([plain.tone, plain.step], ['bad', 10]);
  const header = { first_counted: 0, no_diagnosis: 'this filter has no healthy record' };
  const { evidence } = finding({ ...run(11), header }, 0, null);
  assert.match(evidence, /\. This filter has no healthy record\.$/);
  const consistent = { ...run(11), largestDeviation: () => ({ sigmas: 1, component: 'x' }) };
  assert.match(
    finding(consistent, 0, HEALTHY).headline,
    /^No fault found: position RMSE 0\.56 cm; image has 38 % of/,
  );
  assert.match(
    finding({ ...consistent, header: { first_counted: 8 } }, 0, HEALTHY).headline,
    /^No fault found: position RMSE 0\.60 cm from step 8 on; image has 47 % of/,
    'without the warm-up',
  );
  const largest_error = {
    episode: 0,
    step: 10,
    size: '',
    sources: 'image 1.20 cm, dynamics -0.20 cm',
  };
  const healthy = finding(run(11), 0, { ...HEALTHY, largest_error });
  assert.equal(healthy.headline, 'No fault found, but the filter is overconfident at step 10.');
  assert.match(healthy.evidence, /By source: image 1\.20 cm, dynamics \u22120\.20 cm\. Fused/);
  const poor = finding(run(11), 0, { ...HEALTHY, miscalibrated: true });
  assert.equal(
    poor.headline,
    'Healthy: all is normal.',
    'the record, which the diagnosis describes',
  );
});

test('the largest error of the warm-up is no finding', () => {
  const error = () => series((t) => (t === 3 ? 9 : t === 11 ? 1 : 0.5));
  const steps = (/** @type {number} */ first_counted) =>
    [null, FAULT.causes[0].steps].map((cause) => {
      const trace = { ...run(11), error, header: { first_counted } };
      if (!cause) return finding(trace, 0, null).step;
      const evidence = [{ text: 'it is biased', step: null }];
      const causes = [{ ...FAULT.causes[0], steps: null, evidence }];
      return finding(trace, 0, { ...FAULT, causes }).step;
    });
  assert.deepEqual(steps(5), [11, 11]);
  assert.deepEqual(steps(0), [3, 3]);
  assert.equal(largestErrorStep({ ...run(11), error, header: { first_counted: STEPS } }), 3);
});

test('the largest error of several episodes is an evidence with its sources', () => {
  const error = {
    episode: 165,
    step: 8,
    size: 'position error 2.53 cm',
    sources: '',
    overconfident: true,
  };
  const [{ text, episode, step }] = largestError({ episodes: 10, largest_error: error });
  assert.deepEqual([text, episode, step], ['largest position error 2.53 cm', 165, 8]);
  const withSources = { ...error, sources: 'image 2.56 cm' };
  assert.match(
    largestError({ episodes: 2, largest_error: withSources })[0].text,
    / \(image 2\.56 cm\)$/,
  );
  assert.deepEqual(largestError({ episodes: 1, largest_error: error }), [], 'the headline has it');
  assert.deepEqual(largestError({ episodes: 10 }), []);
});

test('an error that grows to the end is a divergence, shown where it begins', () => {
  const grows = series((t) => (t < 12 ? 0.5 : 0.5 * (t - 9)));
  assert.equal(divergence(grows), 15, 'first step above five times the median of the first half');
  const result = finding({ ...run(11), error: () => grows }, 0, null);
  assert.equal(result.headline, 'The estimate diverges from step 15 on.');
  assert.match(result.evidence, /^Largest error at step 19\. Fused error 5\.00 cm,/);
  assert.deepEqual([result.tone, result.step], ['bad', 15]);
  const healthy = finding({ ...run(11), error: () => grows }, 0, HEALTHY);
  assert.equal(healthy.headline, 'No fault found, but the filter is overconfident at step 19.');
  assert.match(
    healthy.evidence,
    /^The estimate diverges from step 15 on\. Largest error at step 19\./,
  );
  assert.equal(healthy.step, 15);
  const predicted = { ...run(11), largestDeviation: () => ({ sigmas: 1, component: 'x' }) };
  assert.match(finding({ ...predicted, error: () => grows }, 0, null).headline, /^Largest error/);
});

test('an error that stays, falls again or jumps at the last step is no divergence', () => {
  for (const [name, value] of Object.entries({
    constant: () => 0.5,
    linear: (/** @type {number} */ t) => t,
    recovers: (/** @type {number} */ t) => (t >= 12 && t < 18 ? 9 : 0.5),
    falls: (/** @type {number} */ t) => (t >= 12 ? 30 - t : 0.5),
    jumps: (/** @type {number} */ t) => (t === STEPS - 1 ? 9 : 0.5),
    unknown: () => NaN,
  }))
    assert.equal(divergence(series(value)), null, name);
  assert.equal(divergence([]), null);
});

test('a defect of a filter without a diagnosis comes before its largest error', () => {
  const failure = { failure: 'ekf.py:make fails at step 9: LinAlgError', restarts: [5, 8] };
  assert.deepEqual(finding({ ...run(11), header: { failure } }, 0, null), {
    tone: 'bad',
    headline: 'The filter fails; this run restarts it at the true state 2 times.',
    evidence: 'ekf.py:make fails at step 9: LinAlgError.',
    step: 5,
  });
  const defects = ['the Jacobian of radar differs by 91 %'];
  const { tone, headline, evidence, step } = finding({ ...run(11), header: { defects } }, 0, null);
  assert.deepEqual([tone, headline], ['bad', 'The Jacobian of radar differs by 91 %.']);
  assert.match(evidence, /^Largest error at step 10\. /);
  assert.equal(step, 10);
});

test('a run without truth has no step to go to', () => {
  const blind = { ...run(11), error: () => series(() => NaN), hasTruth: () => false };
  assert.equal(finding(blind, 0, null).step, null);
  assert.equal(finding(blind, 0, HEALTHY).step, null);
  assert.equal(finding(blind, 0, HEALTHY).headline, 'Healthy: all is normal.');
});

test('the largest number is found, not a missing one', () => {
  assert.equal(largest([NaN, -2, -1, Infinity, -3]), 2);
  assert.equal(largest([NaN]), null);
  assert.equal(largest([]), null);
});

test('a box of the tour lies in the window and beside its part where there is room', () => {
  const [box, view] = [
    { width: 300, height: 150 },
    { width: 1000, height: 700 },
  ];
  /** @param {{left: number, top: number, right: number, bottom: number}} part */
  const check = (part) => {
    const { left, top } = placeBeside(part, box, view);
    assert.ok(left >= 0 && left + box.width <= view.width, JSON.stringify([part, left]));
    assert.ok(top >= 0 && top + box.height <= view.height, JSON.stringify([part, top]));
    return (
      left >= part.right ||
      left + box.width <= part.left ||
      top >= part.bottom ||
      top + box.height <= part.top
    );
  };
  assert.ok(check({ left: 0, top: 0, right: 1000, bottom: 40 }));
  assert.ok(check({ left: 0, top: 500, right: 1000, bottom: 700 }));
  assert.ok(check({ left: 0, top: 0, right: 500, bottom: 700 }));
  assert.ok(check({ left: 600, top: 0, right: 1000, bottom: 700 }));
  assert.ok(!check({ left: 0, top: 0, right: 1000, bottom: 700 }));
  assert.equal(TOUR.length, 6);
});
