/** The finding of a run in words: the diagnosis, an injected fault, an outage, or its largest error. */

/** @import { Trace } from '../data/trace.js' */
/** @import { Diagnosis, DiagnosisCause } from '../types/server.js' */

import { SHOWN } from '../core/constants.js';
import { displayName, fixed, percent, plural, sentence, typeset, withUnit } from '../core/units.js';
import { intervals, sum } from '../data/arrays.js';
import { stepSummary, weightScope } from './step_summary.js';

const MIN_STEPS = 5; // of an outage
const MIN_CHANGE = 0.05; // of a weight
const MIN_RECOVERED = 0.05; // share of the error that an undo removes
const MIN_RISE = 2; // factor of the error in an outage
const BEFORE = 10; // steps that are compared with the outage
const DIVERGED = 5; // times the median error of the first half of the run
const END = 0.1; // share of the steps

/**
 * @typedef {object} Finding
 * @property {'good' | 'bad' | 'warn' | 'none'} tone
 * @property {string} headline
 * @property {string} evidence
 * @property {number | null} step that shows it best
 * @property {string} [component] state component that shows it best; undefined if the main error does
 */

/**
 * Describes a run. A diagnosed fault comes first, then an injected one, an outage of the camera in contact unless the
 * filter fails at another step, an error of a filter without a diagnosis, and the largest error.
 * @param {Trace} trace
 * @param {number} component whose effective weights are described
 * @param {Diagnosis | null} diagnosis null without one
 * @returns {Finding}
 */
export function finding(trace, component, diagnosis) {
  const fault = diagnosis && diagnosis.state !== 'healthy' ? faultFinding(trace, diagnosis) : null;
  if (fault?.evidence) return fault;
  const injected = trace.header.faults ? injectedFinding(trace, component) : null;
  if (injected) {
    const unsure = fault && `Diagnosis: ${fault.headline}`;
    const diagnosed = diagnosis ? (unsure ?? 'The diagnosis does not name it.') : '';
    return { ...injected, evidence: `${diagnosed} ${injected.evidence}`.trim() };
  }
  const worst = worstFinding(trace, component);
  const sources = diagnosis?.largest_error?.sources;
  const cause =
    sources && diagnosis.largest_error?.step === worst.step
      ? typeset(`By source: ${sources}.`)
      : '';
  const summary = [worst.headline, cause, worst.evidence].filter(Boolean).join(' ');
  // As its record, which may be poor.
  const healthy = worst.tone === 'bad' || diagnosis?.miscalibrated ? 'warn' : 'good';
  const failed = worst.tone === 'bad' ? worst.step : null;
  const outage = fault ? null : outageFinding(trace, component, failed);
  if (outage) {
    const { headline, step } = worst;
    const elsewhere = cause && step !== outage.step ? `${headline} ${cause}` : '';
    const evidence = `${outage.evidence} ${elsewhere}`.trim();
    return { ...outage, evidence, tone: diagnosis ? healthy : 'none' };
  }
  if (trace.header.failure) return failureFinding(trace.header.failure);
  const defect = trace.header.defects?.[0];
  if (defect) return { ...worst, tone: 'bad', headline: sentence(defect), evidence: summary };
  if (!diagnosis) {
    const reason = sentence(trace.header.no_diagnosis ?? '');
    return { ...worst, evidence: `${worst.evidence} ${reason}`.trim() };
  }
  const { tone = healthy, headline = healthyHeadline(trace, component, diagnosis, worst) } =
    fault ?? {};
  return { tone, headline, evidence: summary, step: worst.step };
}

/**
 * Describes the failure of a filter by its first restart.
 * @param {NonNullable<Trace['header']['failure']>} failure
 * @returns {Finding}
 */
function failureFinding({ failure, restarts }) {
  const headline = `The filter fails; this run restarts it at the true state ${plural(restarts.length, 'time')}.`;
  return { tone: 'bad', headline, evidence: sentence(failure), step: restarts[0] };
}

/**
 * Says how accurate a run without a fault is and which modality it relies on; that a filter is miscalibrated, or
 * overconfident at a step, comes first.
 * @param {Trace} trace
 * @param {number} component whose effective weights are described
 * @param {Diagnosis} diagnosis
 * @param {Finding} worst of the largest error
 */
function healthyHeadline(trace, component, { headline, miscalibrated }, worst) {
  const first = trace.header.first_counted; // as in the weight audit and reports
  const error = trace.error('fused', 'main');
  const isCounted = (/** @type {number} */ value, /** @type {number} */ step) =>
    step >= first && Number.isFinite(value) && Number.isFinite(error?.[step]);
  const errors = error?.filter(isCounted) ?? [];
  if (miscalibrated || !errors.length) return typeset(sentence(headline));
  const largestStep = largestErrorStep(trace); // as in the diagnosis; a divergence begins before
  if (worst.tone === 'bad' && largestStep !== null)
    return `No fault found, but the filter is overconfident at ${trace.stepLabel(largestStep)}.`;
  const rmse = withUnit(
    fixed(Math.sqrt(mean(errors.map((value) => value ** 2))), 2),
    trace.mainUnit,
  );
  const scope = first ? ` from ${trace.stepLabel(first)} on` : '';
  const [most] = trace.modalities
    .flatMap((name) => {
      const values = trace.weight('effective', name, component)?.filter(isCounted);
      return values?.length ? [{ name, share: mean(values) }] : [];
    })
    .sort((a, b) => b.share - a.share);
  const weight = most
    ? `; ${displayName(most.name)} has ${percent(most.share)} of the effective weight${weightScope(trace, component)}`
    : '';
  return `No fault found: ${trace.task.main.name} RMSE ${rmse}${scope}${weight}.`;
}

/**
 * Describes a fault: the error that it causes, the share of it that an undo removes, and the evidence. A fault without
 * steps of its own shows where the error is largest.
 * @param {Trace} trace
 * @param {Diagnosis} diagnosis of a run that is not healthy
 * @returns {Finding}
 */
function faultFinding(trace, { state, masked, headline, causes }) {
  const [cause] = causes.filter(({ probability }) => probability >= SHOWN);
  const evidence = (cause?.evidence ?? []).slice(0, 1);
  const step = evidence[0]?.step ?? cause?.steps?.[0] ?? null;
  const sentences = evidence.map(({ text }) => sentence(text));
  const recovered = cause?.recovered;
  if (recovered?.error && recovered.error >= MIN_RECOVERED)
    sentences.unshift(
      `Undoing it removes ${percent(recovered.error)} of the ${recovered.measure} error.`,
    );
  if (sentences.length) sentences.unshift(effect(trace, cause?.steps));
  return {
    tone: state === 'fault' && !masked ? 'bad' : 'warn',
    headline: typeset(sentence(headline.replaceAll('`', ''))),
    evidence: typeset(sentences.filter(Boolean).join(' ')),
    step: step ?? largestErrorStep(trace),
    component: affectedComponent(trace.components, cause),
  };
}

/**
 * Returns the state component whose error a cause increases most; undefined if that is the main error, or unknown.
 * @param {{name: string}[]} components
 * @param {Pick<DiagnosisCause, 'recovered'> | undefined} cause
 */
export const affectedComponent = (components, cause) =>
  components.find(({ name }) => displayName(name) === cause?.recovered?.measure)?.name;

/**
 * Describes the injected faults, and the errors before and with them, or the largest one if they are in all steps.
 * @param {Trace} trace
 * @param {number} component whose effective weights are described
 * @returns {Finding}
 */
function injectedFinding(trace, component) {
  const label = sentence(trace.faultLabel).slice(0, -1);
  const [first, last] = [trace.faulty.indexOf(1), trace.faulty.lastIndexOf(1)];
  if (first < 0 || last - first === trace.steps - 1) {
    const { headline, evidence, step } = worstFinding(trace, component);
    const text = `${headline} ${evidence}`.trim();
    return { tone: 'warn', headline: `${label}, in all steps.`, evidence: text, step };
  }
  const end = last + 1 < trace.steps ? ` to ${trace.stepLabel(last)}` : '';
  return {
    tone: 'warn',
    headline: `${label}, from ${trace.stepLabel(first)}${end}.`,
    evidence: errorChange(trace, first, last),
    step: first,
  };
}

/**
 * Describes the effect of a fault: the mean errors before and with it, or the largest error if it has no steps before.
 * Empty without truth.
 * @param {Trace} trace
 * @param {number[] | null | undefined} steps first one of the fault, and first one after it; null if it has none of its own
 */
function effect(trace, steps) {
  const change = steps ? errorChange(trace, steps[0], steps[1] - 1) : '';
  const error = trace.error('fused', 'main');
  const step = largestErrorStep(trace);
  if (change || !error || step === null) return change;
  const size = withUnit(fixed(error[step], 2), trace.mainUnit);
  const { sigmas = NaN, component = '' } = trace.largestDeviation(step) ?? {};
  const deviation = Number.isFinite(sigmas)
    ? `, ${fixed(sigmas, 1)}σ in ${displayName(component)}`
    : '';
  return `Largest ${trace.task.main.name} error ${size} at ${trace.stepLabel(step)}${deviation}.`;
}

/**
 * Compares the mean error in some steps with that before; empty if one of them is unknown.
 * @param {Trace} trace
 * @param {number} first
 * @param {number} last
 */
function errorChange(trace, first, last) {
  const error = trace.error('fused', 'main');
  const [before, during] = [error?.subarray(0, first), error?.subarray(first, last + 1)].map(
    (values) => mean(values?.filter(Number.isFinite) ?? []),
  );
  if (!Number.isFinite(before) || !Number.isFinite(during)) return '';
  const [low, high] = [before, during].map((value) => withUnit(fixed(value, 2), trace.mainUnit));
  const when = last + 1 < trace.steps ? 'in these steps' : 'from then on';
  return `Mean ${trace.task.main.name} error ${low} before, ${high} ${when}.`;
}

/**
 * Describes the largest error of the fused estimate, or its divergence; no headline without truth.
 * @param {Trace} trace
 * @param {number} component
 * @returns {Finding}
 */
function worstFinding(trace, component) {
  const error = trace.error('fused', 'main') ?? [];
  const step = largestErrorStep(trace);
  if (step === null) {
    const headline = 'The true state of this run is unknown.';
    return { tone: 'none', headline, evidence: '', step };
  }
  const { tone, text } = stepSummary(trace, step, component);
  const headline = `Largest error at ${trace.stepLabel(step)}.`;
  const start = tone === 'bad' || tone === 'none' ? divergence(error) : null; // not as predicted
  if (start === null) return { tone, headline, evidence: text, step };
  return {
    tone,
    headline: `The estimate diverges from ${trace.stepLabel(start)} on.`,
    evidence: `${headline} ${text}`,
    step: start,
  };
}

/**
 * First step from which an error is far above the median of its first half, to the end of the run, where it is largest.
 * @param {ArrayLike<number>} error of each step
 * @returns {number | null} null if the error does not grow like this
 */
export function divergence(error) {
  const values = Array.from(error);
  const first = values.slice(0, values.length / 2).filter(Number.isFinite);
  const median = first.sort((a, b) => a - b)[Math.floor(first.length / 2)];
  const start = values.map((value) => value > DIVERGED * median).lastIndexOf(false) + 1;
  const end = (1 - END) * values.length;
  return start <= end && (largest(values) ?? -1) >= end ? start : null;
}

/**
 * Describes the first outage of the camera that begins in contact; null if there is none.
 * @param {Trace} trace
 * @param {number} component whose effective weights are described
 * @param {number | null} [failed] step of a failure that must begin in the outage
 * @returns {Omit<Finding, 'tone'> | null}
 */
export function outageFinding(trace, component, failed = null) {
  const { modalities } = trace;
  if (modalities.length && !modalities.some((name) => name.includes('image'))) return null;
  const outage = intervals(trace.blackout).find(
    ([first, last]) =>
      first &&
      trace.contact[first] &&
      last - first >= MIN_STEPS - 1 &&
      (failed === null ||
        (first <= failed &&
          failed <= last &&
          stepSummary(trace, first - 1, component).tone !== 'bad')),
  );
  if (!outage) return null;
  const [first, last] = outage;
  const weights = trace.modalities
    .filter((name) => name !== 'image')
    .flatMap((name) => {
      const values = trace.weight('effective', name, component);
      if (!values) return [];
      const before = mean(values.subarray(Math.max(0, first - BEFORE), first));
      return [{ name, before, during: mean(values.subarray(first, last + 1)) }];
    });
  const successor = weights.find(
    ({ before, during }) => during - before >= MIN_CHANGE && during > 0.5,
  );
  const end =
    last + 1 < trace.steps
      ? `until the image returns at ${trace.stepLabel(last + 1)}`
      : 'to the end';
  const action = successor ? `; ${displayName(successor.name)} takes over ${end}` : `, ${end}`;
  const scope = weightScope(trace, component);
  const evidence = weights.map(
    ({ name, before, during }) =>
      `the mean effective weight of ${displayName(name)}${scope} ${change(before, during)}`,
  );
  const error = trace.error('fused', 'main');
  const worst = Math.max(...(error?.subarray(first, last + 1) ?? [NaN]));
  const before = error?.[first - 1] ?? NaN;
  const text = (/** @type {number} */ value) => withUnit(fixed(value), trace.mainUnit);
  if (worst >= MIN_RISE * before)
    evidence.push(`the ${trace.task.main.name} error rises from ${text(before)} to ${text(worst)}`);
  else if (worst >= 0)
    evidence.push(
      `the ${trace.task.main.name} error stays below ${text(Math.ceil(10 * worst) / 10)}`,
    );
  return {
    headline: `The camera goes dark at ${trace.stepLabel(first)}, in contact${action}.`,
    evidence: sentence(evidence.join('; ')),
    step: first,
  };
}

/**
 * Step of the largest error of the fused estimate after the warm-up, as in metrics; null without truth.
 * @param {Trace} trace
 */
export function largestErrorStep(trace) {
  const error = Array.from(trace.error('fused', 'main') ?? []);
  const first = trace.header.first_counted;
  return largest(error.map((value, step) => (step < first ? NaN : value))) ?? largest(error);
}

/**
 * Index of the largest number; null without any.
 * @param {ArrayLike<number>} values
 */
export function largest(values) {
  /** @type {number | null} */
  let result = null;
  for (let i = 0; i < values.length; i++)
    if (Number.isFinite(values[i]) && !(result !== null && values[i] <= values[result])) result = i;
  return result;
}

/**
 * Describes the change of a weight in an outage.
 * @param {number} before
 * @param {number} during
 */
function change(before, during) {
  if (Math.abs(during - before) >= MIN_CHANGE)
    return `${during > before ? 'rises' : 'falls'} from ${percent(before)} before to ${percent(during)} in the outage`;
  return `stays at ${percent(during)}${during < 1 - MIN_CHANGE ? ', although the image is lost' : ''}`;
}

/** @param {ArrayLike<number>} values */
const mean = (values) => sum(Array.from(values)) / values.length;
