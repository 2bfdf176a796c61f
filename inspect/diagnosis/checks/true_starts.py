"""Single steps of an external filter that start at true states: what they show does not depend on its other parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.belief import Gaussian
from beliefscope.filters.external.calls import takes_start
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.external.unavailable import UnavailableFilter
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.innovations import AnyArray, prediction_of
from beliefscope.inspect.statistics.measures import Array
from beliefscope.inspect.trace import Trace

START_STD, PRECISION = 1e-3, 1e-5
"""Smallest standard deviation of a belief at a true state, relative to that of the states and to their largest value,
since beliefs may have single precision. What a prediction adds to it is the process noise."""

SMALLEST_SPREAD, LARGEST_STD = 1e-2, 0.1
"""Smallest and largest one, relative to that of the states, of particles whose likelihoods are compared."""

MOST_CALLS, MOST_PARTICLES = 60, 100_000
"""Largest number of calls of a filter of single trajectories, and of particles of all steps together."""

MOVED = 5.0
"""Smallest predicted change in standard deviations of the belief at a true state, which are also those of particles."""

LEAST_STEPS = 12
"""Smallest number of steps, and of those with a reading of each modality."""


def has_true_starts(checkpoint: ExternalFilter) -> bool:
    """Whether the filter is here, and can start a single step at a given belief."""
    return not isinstance(checkpoint, UnavailableFilter) and takes_start(checkpoint.adapter.module)


def uses_start(trace: Trace, checkpoint: ExternalFilter) -> bool:
    """Whether a step of the filter depends on the mean of the belief that it starts at; false only for equal results.

    Filters that ignore it, such as recurrent networks, show nothing by steps from true states.
    """
    step, states = some_steps(trace, checkpoint)[:1], trace.episode.states
    moved = replace(trace, episode=replace(trace.episode, states=states + np.maximum(states.std(0), 1e-3)))
    first, second = (run_from_truth(run, checkpoint, step, smallest_std(trace)) for run in (trace, moved))
    if first is None or second is None:
        return True
    return first.keys() != second.keys() or any(
        not np.array_equal(value, second[name], equal_nan=True) for name, value in first.items()
    )


def some_steps(trace: Trace, checkpoint: ExternalFilter) -> NDArray[np.intp]:
    """Steps that are started at true states: counted ones, almost evenly spaced if they are not all."""
    steps = 1 + np.flatnonzero(measures.counted(trace)[1:])
    calls = len(steps) if checkpoint.adapter.batched else MOST_CALLS
    particles = 1 if trace.particles is None else trace.particles.shape[1]
    return _evenly(steps, max(LEAST_STEPS, min(calls, MOST_PARTICLES // particles)))


def _evenly(steps: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    return steps if len(steps) <= most else steps[np.linspace(0, len(steps) - 1, most).round().astype(np.intp)]


def smallest_std(trace: Trace) -> Array:
    """(n,) smallest standard deviations of a belief at the states of an episode."""
    states = trace.episode.states.astype(np.float64)
    return np.maximum(START_STD * states.std(0), PRECISION * np.maximum(np.abs(states).max(0), 1e-3))


@dataclass(frozen=True)
class Predictions:
    """Predictions of S single steps from the true states before them, SI units.

    Attributes:
        change: (S, n) predicted changes.
        added: (S, n, n) covariance that is added to that of the start; None without covariances.
        calls: of the filter in each step.
    """

    change: Array
    added: Array | None
    calls: int


def predictions_from_truth(trace: Trace, checkpoint: ExternalFilter, steps: NDArray[np.intp]) -> Predictions | None:
    """Predictions of some steps (S,).

    Each step is a call of the filter, or the second one if the first only updates the belief, as the belief is too
    certain to be changed by an update. None if the filter fails or reports no predictions.
    """
    square = np.square(smallest_std(trace))
    for calls in (1, 2):
        predictions = predictions_by_calls(trace, checkpoint, steps, calls)
        if predictions is None:
            return None
        added = predictions.added
        is_noisy = added is not None and (np.diagonal(added, axis1=-2, axis2=-1) > square).any()
        if is_noisy or (np.abs(predictions.change) > MOVED * np.sqrt(square)).any():
            break
    return predictions


def predictions_by_calls(
    trace: Trace, checkpoint: ExternalFilter, steps: NDArray[np.intp], calls: int, controls: Array | None = None
) -> Predictions | None:
    """Those of ``predictions_from_truth`` by a number of calls, with the episode's controls or other ones (S, m)."""
    std = smallest_std(trace)
    values = run_from_truth(trace, checkpoint, steps, std, calls, controls)
    names = ("predicted_mean", "predicted_covariance", "particles", "prior_log_weights")
    belief = None if values is None else prediction_of(trace.task, *map(values.get, names))
    if belief is None:
        return None
    change = trace.task.difference(belief.mean, trace.episode.states[steps - 1].astype(np.float64))
    added = None if belief.covariance is None else belief.covariance - np.diag(np.square(std))
    return Predictions(change, added, calls)


def run_from_truth(
    trace: Trace,
    checkpoint: ExternalFilter,
    steps: NDArray[np.intp],
    std: Array,
    calls: int = 1,
    controls: Array | None = None,
) -> dict[str, AnyArray] | None:
    """Values of the steps (S, ...), SI units, by the last of some calls from the true states before them.

    The beliefs at the states have standard deviations (n,). controls: (S, m) those of all calls of a step; default: the
    episode's. None if the filter fails.
    """
    before, covariance = trace.episode.states[steps - 1].astype(np.float64), np.diag(np.square(std))
    start = Gaussian(torch.from_numpy(before), torch.from_numpy(covariance).expand(len(steps), *covariance.shape))
    episodes = [trace.episode.part(int(step) + 1 - calls, int(step) + 1) for step in steps]
    if controls is not None:
        repeated = controls.astype(np.float32)[:, None].repeat(calls, axis=1)
        episodes = [replace(episode, controls=own) for episode, own in zip(episodes, repeated, strict=True)]
    try:
        values, _ = checkpoint.run(episodes, trace.seed, start=start)
    except BadInput:
        return None
    return {name: value[-1].numpy() for name, value in values.items()}


def with_particles_near_truth(trace: Trace, checkpoint: ExternalFilter) -> Trace:
    """The trace with particles and likelihoods of steps from true states, NaN at others.

    Particles of a filter that has lost the state are too far from the readings to show its likelihood. Their spread at
    the start is that of the estimates, within limits. The same trace if the steps cannot be run.
    """
    if trace.particles is None or trace.log_likelihood is None:
        return trace
    states = trace.episode.states.astype(np.float64)
    variance = np.nanmedian(np.diagonal(trace.estimate_covariance, axis1=-2, axis2=-1), axis=0).astype(np.float64)
    largest, smallest = LARGEST_STD * states.std(0), np.maximum(SMALLEST_SPREAD * states.std(0), smallest_std(trace))
    std = np.maximum(np.minimum(np.sqrt(np.maximum(np.nan_to_num(variance), 0.0)), largest), smallest)
    return _near_truth(trace, checkpoint, ("particles", "log_likelihood"), std)


def with_innovations_near_truth(trace: Trace, checkpoint: ExternalFilter) -> Trace:
    """As ``with_particles_near_truth``, with innovations, their covariances and the means before and after the updates.

    At other steps these means are the true states: angles are continuous over all steps.
    """
    if trace.innovation is None or trace.predicted_mean is None:
        return trace
    names = ("innovation", "innovation_covariance", "predicted_mean", "estimate_mean")
    near = _near_truth(trace, checkpoint, names, smallest_std(trace))
    predicted, estimate, truth = near.predicted_mean, near.estimate_mean, trace.episode.states
    if near is trace or predicted is None:
        return trace
    return replace(
        near,
        predicted_mean=np.where(np.isnan(predicted), truth[:, None], predicted),
        estimate_mean=np.where(np.isnan(estimate), truth, estimate),
    )


def _near_truth(trace: Trace, checkpoint: ExternalFilter, names: Sequence[str], std: Array) -> Trace:
    """The trace with values of steps from true states, whose beliefs have standard deviations (n,), NaN at others.

    Of ``some_steps``, and of steps with a reading of each modality.
    """
    if not has_true_starts(checkpoint) or not uses_start(trace, checkpoint):
        return trace
    counted = measures.counted(trace)
    read = (1 + np.flatnonzero((counted & ~measures.absent(trace, m))[1:]) for m in trace.modalities)
    steps = np.unique(np.concatenate([some_steps(trace, checkpoint), *(_evenly(at, LEAST_STEPS) for at in read)]))
    values = run_from_truth(trace, checkpoint, steps, std) if len(steps) else None
    if values is None or any(name not in values for name in names):
        return trace
    filled: dict[str, Any] = {n: np.full((len(trace), *values[n].shape[1:]), np.nan, np.float32) for n in names}
    for name, array in filled.items():
        array[steps] = values[name]
    return replace(trace, **filled)
