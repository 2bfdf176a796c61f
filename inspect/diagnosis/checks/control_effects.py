"""The effect of each control on the true changes of the state, relative to the one that an external filter predicts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtri

from beliefscope.datasets.task import axis_name
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnosis.checks.true_starts import Predictions, predictions_by_calls
from beliefscope.inspect.diagnosis.checks.vectors import commands_hand
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.measures import Array
from beliefscope.inspect.statistics.reading_features import monomials
from beliefscope.inspect.trace import Trace

LEAST = 10
"""Smallest number of steps beyond that of unknowns; twice as many where there are enough."""

LARGEST_STD = 1.0
"""Largest standard deviation of the slope of an episode; several episodes have a mean of less."""

TWO = 2
"""Number of values of a control that is a flag."""

NEEDED = 1e-3
"""Probability of noise that is explained as well as the true effects, below which the features are needed."""

OWN = 0.05
"""Smallest part of an effect that does not follow from the state and the other controls, which explain the rest."""


def control_effects(
    trace: Trace, checkpoint: ExternalFilter, steps: NDArray[np.intp], predictions: Predictions, change: Array
) -> dict[str, float]:
    """``dynamics effect/CHANNEL/COMPONENT``: slope of the true on the predicted effect of a control on the next state.

    It is -1 for a wrong sign in the dynamics, and 1/2 if the dynamics take twice the control. The predicted effect is
    the difference d of two predictions, with the control and with its median. The true changes (S, n) minus the second
    prediction are ``slope * d`` plus errors of other parts of the dynamics, linear in the state and the other controls,
    plus noise. Absent where the control changes nothing, only as the state does, or too little, for controls that
    command a measured hand, and for those with two values, such as a closed gripper: the other value does not occur in
    the same states, for which learned dynamics have no training data.
    """
    task, size = trace.task, trace.task.control_size
    if commands_hand(task):
        return {}
    state = np.column_stack([np.ones(len(trace)), monomials(trace.episode, False, 1)])[steps - 1]
    controls = trace.episode.controls[steps].astype(np.float64)
    flags = [i for i in range(size) if len(np.unique(trace.episode.controls[:, i])) <= TWO]
    values = {}
    spacing = max(1, min(size, len(steps) // (state.shape[1] + size + 2 * LEAST)))  # controls take turns in a run
    for first in range(0, size, spacing):  # the same steps have the same random numbers in each run
        channel = first + np.arange(len(steps)) % spacing
        channels = [i for i in range(first, min(first + spacing, size)) if i not in flags]
        if not channels:
            continue
        chosen = channel[:, None] == np.arange(size)
        others = np.where(chosen, np.median(trace.episode.controls, axis=0), controls)
        without = predictions_by_calls(trace, checkpoint, steps, predictions.calls, others)
        if without is None:
            return {}
        effect = measures.wrapped(task, predictions.change - without.change)
        rest = measures.wrapped(task, change - without.change)
        for i in channels:
            own = chosen[:, i]
            slopes = _slopes(rest[own], effect[own], np.column_stack([state, np.delete(controls, i, axis=1)])[own])
            for component, slope in zip(task.components, slopes, strict=True):
                values[f"dynamics effect/{axis_name('control', i, size)}/{component.name}"] = float(slope)
    return {name: value for name, value in values.items() if np.isfinite(value)}


def _slopes(true: Array, predicted: Array, state: Array) -> Array:
    """(n,) slopes of true on predicted effects (S, n) besides linear functions of features (S, F); NaN if unknown.

    Besides a constant where the features explain no more of the rest than noise does (F test): controls that depend on
    the state, and so on the noise before, bias the slope that has them in an episode of few steps.
    """
    free = len(true) - state.shape[1] - 1
    if free < LEAST:
        return np.full(true.shape[1], np.nan)
    basis, sizes, _ = np.linalg.svd(state / np.maximum(np.abs(state).max(0), 1e-12), full_matrices=False)
    basis = basis[:, sizes > 1e-6 * sizes[0]]
    y, d = (values - basis @ (basis.T @ values) for values in (true, predicted))
    power, total = np.square(d).sum(0), np.square(predicted - predicted.mean(0)).sum(0)
    is_own = power > OWN**2 * total
    (slopes, left), (others, left_of_others) = _line(y, d), _line(true - true.mean(0), predicted - predicted.mean(0))
    variance, extra = left / free, max(basis.shape[1] - 1, 1)
    needed = left_of_others - left > extra * fdtri(extra, free, 1.0 - NEEDED) * variance
    slopes, power = np.where(needed, slopes, others), np.where(needed, power, total)
    return np.where(is_own & (variance < LARGEST_STD**2 * power), slopes, np.nan)


def _line(y: Array, d: Array) -> tuple[Array, Array]:
    """(n,) slopes of y on d, both (S, n), and sums of the squares that are left; NaN where d is zero."""
    power = np.square(d).sum(0)
    slopes = (d * y).sum(0) / np.where(power > 0.0, power, np.nan)
    return slopes, np.square(y - slopes * d).sum(0)
