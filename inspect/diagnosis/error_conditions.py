"""The condition under which single steps of an external filter are wrong: where in its code to look."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.task import Component, display_name
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnosis.cause import Cause
from beliefscope.inspect.diagnosis.checks.true_starts import (
    has_true_starts,
    predictions_from_truth,
    run_from_truth,
    smallest_std,
    some_steps,
)
from beliefscope.inspect.slices.covariates import StepCovariate
from beliefscope.inspect.slices.search import find_candidates
from beliefscope.inspect.statistics.measures import Array
from beliefscope.inspect.trace import Trace

SMALLEST_RATIO = 2.0
"""Smallest ratio of the errors of the steps under a condition to those of the others that is mentioned."""

LARGEST_RATIO = 100.0
"""Ratios from which the text does not state the number."""

EXACT = 1e-3
"""Largest median of errors relative to their mean that is rounding."""

MIN_STEPS = 100
"""Smallest number of steps that are searched."""


def error_condition(traces: Sequence[Trace], checkpoint: ExternalFilter, cause: Cause) -> str:
    """A sentence that names the states or controls with the largest errors of steps from true states; empty if none.

    The errors are those of predictions for a cause in the dynamics, and innovations for one in a measurement model.
    """
    part, _, rest = cause.name.partition(".")
    modality = rest.partition(".")[0]
    if part not in ("dynamics", "measurement", "innovation") or not has_true_starts(checkpoint):
        return ""
    errors, steps = [], []
    for trace in traces:
        chosen = some_steps(trace, checkpoint)
        if part == "dynamics":
            own = _prediction_errors(trace, checkpoint, chosen)
        else:
            own = _innovations(trace, checkpoint, chosen, modality)
        if own is None:
            return ""
        known = np.isfinite(own).any(-1)
        errors.append(own[known])
        steps.append(chosen[known])
    if len({own.shape[1] for own in errors}) != 1 or sum(map(len, steps)) < MIN_STEPS:
        return ""
    score = _squares(np.concatenate(errors))
    number = np.repeat(np.arange(len(steps)), [len(each) for each in steps])
    columns = _covariates(traces, steps, 1 if part == "dynamics" else 0)
    found = find_candidates(score, number, [each for each in columns if np.ptp(each.values) > 0.0], most=1)
    if not found:
        return ""
    inside = found[0].steps
    ratio = math.sqrt(score[inside].mean() / max(score[~inside].mean(), 1e-12))
    if ratio < SMALLEST_RATIO:
        return ""
    what = "prediction errors" if part == "dynamics" else f"innovations of {display_name(modality)}"
    where = " and ".join(map(str, found[0].conditions))
    times = f"{ratio:.2g}" if ratio < LARGEST_RATIO else f"more than {LARGEST_RATIO:.0f}"
    return f"Start with the steps where {where}: their {what} are {times} times those of the other steps."


def _prediction_errors(trace: Trace, checkpoint: ExternalFilter, steps: NDArray[np.intp]) -> Array | None:
    """(S, n) of the predictions of steps from true states; None if there are none."""
    predictions = predictions_from_truth(trace, checkpoint, steps)
    if predictions is None:
        return None
    states = trace.episode.states.astype(np.float64)
    change = trace.task.difference(states[steps], states[steps - 1])
    return np.asarray(trace.task.difference(predictions.change, change))


def _innovations(trace: Trace, checkpoint: ExternalFilter, steps: NDArray[np.intp], modality: str) -> Array | None:
    """(S, m) innovations of a modality at steps from true states, NaN without a reading; None if there are none."""
    values = run_from_truth(trace, checkpoint, steps, smallest_std(trace))
    if values is None or "innovation" not in values or modality not in trace.modalities:
        return None
    own = values["innovation"][:, trace.modalities.index(modality)].astype(np.float64)
    return np.asarray(own)


def _squares(errors: Array) -> Array:
    """(S,) sums of squares of errors (S, n), each relative to the median of its size, or to its mean; without NaN."""
    errors = errors[:, np.isfinite(errors).any(0)]
    median, mean = np.nanmedian(np.abs(errors), axis=0), np.nanmean(np.abs(errors), axis=0)
    sizes = np.where(median > EXACT * mean, median, mean)  # without noise, most errors are 0
    return np.asarray(np.nansum(np.square(errors / np.where(sizes > 0.0, sizes, np.inf)), axis=-1))


def _covariates(traces: Sequence[Trace], steps: Sequence[NDArray[np.intp]], before: int) -> Iterator[StepCovariate]:
    """The controls of the steps and the true states, at the step or ``before`` it, in units for display."""
    task = traces[0].task
    controls = np.concatenate([trace.episode.controls[at] for trace, at in zip(traces, steps, strict=True)])
    states = np.concatenate([trace.episode.states[at - before] for trace, at in zip(traces, steps, strict=True)])
    for i in range(task.control_size):
        channel = task.channel("control", i)
        yield _covariate(display_name(channel.name), channel, controls[:, i])
    for i, component in enumerate(task.components):
        yield _covariate(f"true {component.label}", component, states[:, i])


def _covariate(name: str, component: Component, values: Array) -> StepCovariate:
    unit, factor = component.conversion
    if component.wraps:
        values = np.arctan2(np.sin(values), np.cos(values))
    return StepCovariate(name, unit, factor * values.astype(np.float64))
