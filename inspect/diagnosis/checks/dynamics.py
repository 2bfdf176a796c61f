"""Statistics of a filter's dynamics, from predictions of single steps that start at the true previous state."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Task, axis_name
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.models.dynamics import Dynamics
from beliefscope.filters.models.information import InformationFilter
from beliefscope.inspect.diagnosis.checks.control_effects import control_effects
from beliefscope.inspect.diagnosis.checks.true_starts import (
    Predictions,
    has_true_starts,
    predictions_by_calls,
    predictions_from_truth,
    some_steps,
    uses_start,
)
from beliefscope.inspect.diagnosis.checks.vectors import commands_hand
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.innovations import prediction
from beliefscope.inspect.statistics.measures import Array, Mask
from beliefscope.inspect.statistics.signals import lag
from beliefscope.inspect.trace import Trace

MIN_PATH = 0.3
"""Minimum path of a component for a slope of the dynamics, in standard deviations of the training data."""

MIN_STEPS = 10
"""Minimum number of steps of a statistic."""

NEAR_ANGLE = 0.2
"""Largest error of an angle, rad, from which a prediction of the run shows the dynamics."""

PREDICTED = 0.05
"""Smallest variance of the predicted changes, relative to that of the true ones, for a slope on them."""

LARGEST_GAIN = 10.0
"""Largest gain of predicted changes; the true ones hardly depend on those of a larger one."""

ROUNDING = 1e-12
"""Largest variance that a prediction adds by rounding, relative to that of the states; smallest process noise."""


def dynamics_statistics(trace: Trace, checkpoint: Checkpoint) -> dict[str, float]:
    """``KIND/COMPONENT/all`` -> value, SI units, with residual r of the predicted change, and process noise q.

    ``dynamics error``: root mean square of r. ``dynamics nis``: mean of (r / q)^2, where the q of an information filter
    grows with the motion. ``dynamics slope``: slope of the predicted on the true change, for components that move
    enough; of predictions from true states, the inverse of that of the true on the predicted one, which the process
    noise does not decrease, and ``dynamics response``, the former, which noise in the controls does not decrease.
    ``dynamics bias`` and ``dynamics spread``: mean and standard deviation of r that the slope
    does not explain.
    ``process noise``: q. ``lag/dynamics``: steps by which the true changes follow the predicted ones.

    Of this project's filters also ``opposed/control``, of controls that do not command a measured hand: log-ratio of
    the size of r to that with the opposite sign of the channel; 0 if the present sign fits better. Of external filters
    also ``dynamics offset``: mean residual of the run's predictions, which start at the filter's estimates; it differs
    between episodes if the filter does not estimate a bias; and ``dynamics effect`` of ``control_effects``; and
    ``ignored start``: 1 if no step depends on the belief that it starts at, else 0.
    """
    if isinstance(checkpoint, ExternalFilter):
        return external_dynamics_statistics(trace, checkpoint)
    return module_dynamics_statistics(trace.episode, checkpoint)


@torch.no_grad()
def module_dynamics_statistics(episode: Episode, checkpoint: Checkpoint) -> dict[str, float]:
    """Those of ``dynamics_statistics`` of a dynamics model."""
    filter_ = checkpoint.filter
    if not isinstance(getattr(filter_, "dynamics", None), Dynamics) or len(episode) < MIN_STEPS:
        return {}
    si = filter_.statistics
    states = si.standardise("state", torch.from_numpy(episode.states))
    controls = si.standardise("control", torch.from_numpy(episode.controls))
    before, after = states[:-1], states[1:]
    predicted = filter_.dynamics(before, filter_.dynamics.control_part(controls[1:]))
    std = si.mean_std("state")[1].double().numpy()
    noise = filter_.dynamics.noise.double().numpy() * std
    used = (
        filter_.process_noise(predicted - before) if isinstance(filter_, InformationFilter) else filter_.dynamics.noise
    )
    residual = measures.wrapped(filter_.task, (predicted - after).double().numpy() * std)
    change = measures.wrapped(filter_.task, (after - before).double().numpy() * std)
    nis = (np.square(residual) / (used.double().numpy() * std) ** 2).mean(0)
    values = _of_changes(filter_.task, residual, change, {"dynamics nis": nis, "process noise": noise}, std)
    values |= _lag(change, change + residual, std)
    if commands_hand(episode.task):
        return values
    signs = 1.0 - 2.0 * torch.eye(controls.shape[1])[:, None]
    controls = si.standardise("control", signs * torch.from_numpy(episode.controls[1:]))
    opposite = filter_.dynamics(before, filter_.dynamics.control_part(controls))
    other = measures.wrapped(filter_.task, (opposite - after).double().numpy() * std)
    moved = _moved(change, std)
    size, sizes = (np.square((r / std)[..., moved]).sum((-2, -1)) for r in (residual, other))
    for i, ratio in enumerate(size / np.maximum(sizes, 1e-12)):
        values[f"opposed/{axis_name('control', i, len(signs))}/all"] = 0.5 * math.log(max(ratio, 1.0))
    return values


def external_dynamics_statistics(trace: Trace, checkpoint: ExternalFilter) -> dict[str, float]:
    """Those of ``dynamics_statistics`` of an external filter.

    If its steps cannot start at a given belief, the predictions are those of the run.
    """
    belief = prediction(trace)
    states, task = trace.episode.states.astype(np.float64), trace.task
    steps = 1 + np.flatnonzero(measures.counted(trace)[1:])
    if len(steps) < MIN_STEPS:
        return {}
    starts = has_true_starts(checkpoint)
    ignores = starts and not uses_start(trace, checkpoint)
    ignored = {"ignored start//all": float(ignores)} if starts else {}
    if belief is None:
        return ignored
    change = task.difference(states[steps], states[steps - 1])
    predicted = task.difference(belief.mean[steps], trace.estimate_mean[steps - 1].astype(np.float64))
    values = _lag(change, predicted, states.std(0))
    values |= _by_component(
        task, {"dynamics offset": _offset(trace, steps, measures.wrapped(task, predicted - change))}
    )
    values |= ignored
    if ignores:
        return values
    if starts:
        steps = some_steps(trace, checkpoint)
        started = predictions_from_truth(trace, checkpoint, steps)
        if started is None:
            return values
        change, predicted, added = task.difference(states[steps], states[steps - 1]), started.change, started.added
        values |= control_effects(trace, checkpoint, steps, started, change)
        random = _random_variance(trace, checkpoint, steps, started)
    else:
        added = random = None
        if belief.covariance is not None and trace.has_covariance:
            added = belief.covariance[steps] - trace.estimate_covariance[steps - 1].astype(np.float64)
    residual = measures.wrapped(task, predicted - change)
    more: dict[str, Array] = {}
    if added is not None:
        smallest = ROUNDING * np.square(states.std(0))
        variance = np.maximum(np.median(np.diagonal(added, axis1=-2, axis2=-1), axis=0), smallest)
        squared = np.maximum(np.square(residual).mean(0), smallest)
        more = {"dynamics nis": squared / variance, "process noise": np.sqrt(variance)}
    return values | _of_changes(task, residual, change, more, states.std(0), random)


def _random_variance(
    trace: Trace, checkpoint: ExternalFilter, steps: NDArray[np.intp], predictions: Predictions
) -> Array:
    """(n,) variance of the predicted changes by random numbers, such as those of particles: that of two seeds."""
    other = predictions_by_calls(replace(trace, seed=trace.seed + 1), checkpoint, steps, predictions.calls)
    if other is None:
        return np.zeros(predictions.change.shape[1])
    return 0.5 * np.square(measures.wrapped(trace.task, predictions.change - other.change)).mean(0)


def _offset(trace: Trace, steps: NDArray[np.intp], residual: Array) -> Array:
    """(n,) mean of the residuals (S, n) of a run's predictions that start with nearly true angles; NaN without any.

    With another heading, correct dynamics predict another change of the position.
    """
    angles = list(trace.task.angles)
    error = np.abs(measures.errors(trace)[steps - 1, -1][:, angles])
    near = np.ones(len(steps), bool) if not angles else (error < NEAR_ANGLE).all(1)
    return residual[near].mean(0) if near.sum() >= MIN_STEPS else np.full(residual.shape[1], np.nan)


def _lag(change: Array, predicted: Array, std: Array) -> dict[str, float]:
    """``lag/dynamics`` of predicted and true changes (T, n), of components that move."""
    moved = _moved(change, std)
    if not moved.any():
        return {}
    return {"lag/dynamics/all": lag(change[:, moved] / std[moved], predicted[:, moved] / std[moved])[0]}


def _moved(change: Array, std: Array) -> Mask:
    """(n,) components that move enough for a slope."""
    return np.asarray(np.abs(change).sum(0) > MIN_PATH * std)


def _of_changes(
    task: Task, residual: Array, change: Array, more: Mapping[str, Array], std: Array, random: Array | None = None
) -> dict[str, float]:
    """Statistics of residuals (T, n) of predicted changes, of states with standard deviations (n,).

    random: (n,) variance of the predictions by random numbers, if they start at true states and so have no other noise.
        Slope, bias and spread are then those of a line over the predicted changes: the slope on the true ones decreases
        with the process noise, so that it depends on the variation of the motion, and its intercept on the speed.
    """
    moved = _moved(change, std)
    centred, around = residual - residual.mean(0), change - change.mean(0)
    excess = np.where(moved, (centred * around).sum(0) / np.maximum(np.square(around).sum(0), 1e-12), 0.0)
    bias, spread = residual.mean(0) - excess * change.mean(0), (centred - excess * around).std(0)
    gain = 1.0 + excess
    more = dict(more) if random is None else {"dynamics response": np.where(moved, gain, np.nan), **more}
    if random is not None:
        predicted = residual + change
        distance = predicted - predicted.mean(0)
        total = np.square(distance).sum(0)
        power = total - len(predicted) * random
        varies = moved & (power > PREDICTED * np.square(around).sum(0))
        power = np.maximum(np.where(varies, power, total), 1e-12)
        inverse = (around * distance).sum(0) / power  # slope of the true on the predicted changes
        bias = np.where(varies, inverse * predicted.mean(0) - change.mean(0), bias)
        spread = (inverse * distance - around).std(0)
        # The mean of 1 / inverse is too large by this variance of its noise, relative to the square of the inverse.
        squared = np.square(inverse) + np.square(spread) / power
        own = np.clip(inverse / np.maximum(squared, 1e-12), -LARGEST_GAIN, LARGEST_GAIN)
        gain = np.where(varies, own, gain)
    columns = {
        "dynamics bias": bias,
        "dynamics error": np.sqrt(np.square(residual).mean(0)),
        "dynamics slope": np.where(moved, gain, np.nan),
        "dynamics spread": spread,
    }
    return _by_component(task, columns | dict(more))


def _by_component(task: Task, columns: Mapping[str, Array]) -> dict[str, float]:
    """``KIND/COMPONENT/all`` -> value, from columns (n,) by kind."""
    return {
        f"{kind}/{component.name}/all": float(value)
        for kind, column in columns.items()
        for component, value in zip(task.components, column, strict=True)
    }
