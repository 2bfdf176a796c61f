"""Running a filter over a sequence of steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from beliefscope.filters.batch import Batch
from beliefscope.filters.belief import Evidence, Gaussian, StepTrace
from beliefscope.filters.filter import Filter

START_VARIANCE = 0.1
"""Variance of a first belief at the true state, in standardised units, as in the paper's evaluation."""


@dataclass(frozen=True)
class Rollout:
    """estimate: Gaussian (T, N, n), (T, N, n, n), standardised. steps: the T step traces, if kept.

    updates: single-modality updates, Gaussian (T, N, K, n), if requested; None for a filter without any.
    """

    estimate: Gaussian
    steps: list[StepTrace]
    updates: Gaussian | None = None


def first_belief(filter_: Filter, batch: Batch) -> Gaussian:
    """The belief before step 0, standardised: mean (N, n), covariance (N, n, n).

    At the true state with covariance 0.1 I, unless the task starts beside it (``Task.start_distance``).
    """
    statistics = filter_.statistics
    mean = statistics.standardise("state", batch.previous if batch.start is None else batch.start)
    variance = torch.from_numpy(filter_.task.start_variance()).to(mean)
    variance = variance / statistics.mean_std("state")[1].square()
    variance = torch.where(variance.isnan(), START_VARIANCE, variance)
    return Gaussian(mean, torch.diag(variance).expand(len(mean), -1, -1))


def rollout(
    filter_: Filter,
    evidence: Evidence,
    start: Gaussian,
    generator: torch.Generator,
    particles: int = 300,
    keep: bool = False,
    updates: bool = False,
    progress: Callable[[float], None] | None = None,
) -> Rollout:
    """Runs all T steps of ``evidence``. ``keep`` (the step traces) and ``updates`` do not affect the estimates."""
    belief = filter_.start(start, particles, generator)
    estimates: list[Gaussian] = []
    steps: list[StepTrace] = []
    single: list[Gaussian] = []
    for t, (_, trace) in enumerate(filter_.steps(belief, evidence, generator)):
        estimates.append(trace.estimate)
        if keep:
            steps.append(trace)
        if updates and (update := trace.updates(filter_.angles)) is not None:
            single.append(update)
        if progress is not None:
            progress((t + 1) / len(evidence))
    return Rollout(_stacked(estimates), steps, _stacked(single) if single else None)


def _stacked(beliefs: Sequence[Gaussian]) -> Gaussian:
    return Gaussian(torch.stack([b.mean for b in beliefs]), torch.stack([b.covariance for b in beliefs]))
