"""Measurement models of an external filter against the healthy record's models of the readings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from beliefscope.datasets.task import axis_name
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnosis.checks.innovations import MIN_STEPS
from beliefscope.inspect.diagnosis.checks.likelihoods import (
    likelihood_statistics,
    likelihood_turns,
    likelihoods_at_truth,
)
from beliefscope.inspect.diagnosis.checks.true_starts import has_true_starts, run_from_truth, smallest_std, some_steps
from beliefscope.inspect.statistics.array_channels import channel_names
from beliefscope.inspect.statistics.innovations import channels_of, prediction
from beliefscope.inspect.statistics.measures import Mask, absent, counted
from beliefscope.inspect.statistics.reading_model import ReadingModel, readings_of
from beliefscope.inspect.statistics.signals import NEAR_TURN, TURN, Array
from beliefscope.inspect.trace import Trace

MOST_LATE = 3
"""Largest number of readings by which the used one is earlier."""

SAME, OTHER = 0.3, 0.8
"""Largest error of h(x) with the reading that the filter uses, and smallest one with another, relative to its noise."""

OWN_GAIN, CONSTANT = 0.3, 0.02
"""Largest distance from 1 of the gain from a reading to its innovation, and largest relative spread of another one."""

SEPARATE_TURN = 5.0
"""Smallest full turn relative to the root mean square of the other innovations of an angle."""


def measurement_model_statistics(
    trace: Trace, models: Sequence[ReadingModel], near_truth: Trace | None = None
) -> dict[str, float]:
    """``KIND/SUBJECT/all`` -> value, of measurement functions and, in particle filters, of noise and turns.

    near_truth: with values of steps from true states, which show noise and functions of particle filters, and functions
        of Kalman filters, unless they use earlier readings: those of the run. Default: that run.
    """
    models = [model.with_weak_channels() for model in models]
    near_truth = near_truth or trace
    # A filter may report both, and only one of them may be known at true states.
    at_truth = {} if near_truth.innovation is trace.innovation else _innovations_at_truth(near_truth)
    at_truth |= {} if near_truth.log_likelihood is trace.log_likelihood else likelihoods_at_truth(near_truth)
    values, turns = likelihood_statistics(near_truth, models), likelihood_turns(trace, models)
    turns |= {name: max(values[name], share) for name, share in turns.items() if name in values}
    functions = _functions(trace, models)
    is_late = any(value for name, value in functions.items() if name.startswith("late readings/"))
    if near_truth is not trace and not is_late:
        near = _functions(near_truth, models)
        functions |= {name: near[name] for name in near if name.startswith("measurement function/")}
    # The noise of modalities whose readings have a model is more exact than the width of their likelihood.
    widths = {f"likelihood width/{m}/all" for m in trace.modalities if f"measurement noise/{m}/all" in values}
    return functions | values | turns | {name: value for name, value in at_truth.items() if name not in widths}


def _sensors(trace: Trace, k: int, models: Sequence[ReadingModel]) -> list[tuple[ReadingModel, list[int]]]:
    """Models of the vector sensors of modality k, and the columns of their channels among its innovations.

    None if the innovations do not have the channels of all sensors.
    """
    by_key, start = {model.key: model for model in models if not channel_names(trace.task, model.key)}, 0
    sensors = []
    for key in trace.task.modalities.get(trace.modalities[k], ()):
        if (model := by_key.get(key)) is not None:
            sensors.append((model, [start + i for i in model.channels]))
        start += math.prod(trace.task.observations[key])
    width = 0 if trace.innovation is None else trace.innovation.shape[-1]
    return sensors if start <= width else []


def _functions(trace: Trace, models: Sequence[ReadingModel]) -> dict[str, float]:
    """``measurement function/CHANNEL/all``: root mean square error of h(x) in the noise of the readings, by channel.

    The filter has h(x) = z - nu at a state x from the prediction, or the reported belief before the update, to the
    estimate: other updates may come first. The healthy record's model of the sensor expects readings g there, and h(x)
    may be between those at both ends. Neither the sensor nor the dynamics matter. Of innovations with the channels of
    the sensors.

    ``late readings/MODALITY/all``: by how many readings z is earlier than that of the step.
    """
    if trace.innovation is None:
        return {}
    count, means = len(trace.modalities), trace.predicted_mean
    if means is None:
        if (predicted := prediction(trace)) is None:
            return {}
        means = np.repeat(predicted.mean[:, None], count, axis=1)
    keep = counted(trace)
    values: dict[str, float] = {}
    for k in range(count):
        ends = [replace(trace.episode, states=x.astype(np.float32)) for x in (means[:, k], trace.estimate_mean)]
        lateness = []
        for model, columns in _sensors(trace, k, models):
            readings, present = readings_of(trace.episode, model.key), trace.episode.present(model.key)
            innovation, expected = trace.innovation[:, k, columns], [model.expected(end) for end in ends]
            errors = []
            for late in range(MOST_LATE + 1):
                h = _earlier(readings[:, model.channels], present, late) - innovation
                errors.append(_outside([model.relative(h - g)[keep] for g in expected]))
            late, by_channel = _lateness(np.array(errors))
            lateness.append(late)
            for channel, value in zip(model.channels, by_channel.tolist(), strict=True):
                values[f"measurement function/{axis_name(model.key, channel, readings.shape[1])}/all"] = value
        if lateness:
            values[f"late readings/{trace.modalities[k]}/all"] = float(max(lateness))
    return {name: value for name, value in values.items() if math.isfinite(value)}


def is_of_readings(trace: Trace, checkpoint: ExternalFilter, models: Sequence[ReadingModel], axis: str) -> bool:
    """Whether the innovation of a channel can be that of its readings, z - h(x), or of readings in another unit.

    It then changes by a constant factor with a reading. Those of virtual sensors, whose networks have outputs of their
    own, do not; nor can they be compared with the readings. True if single steps do not show it.
    """
    places = (
        (k, model, i, column)
        for k in range(len(trace.modalities))
        for model, columns in _sensors(trace, k, models)
        for i, column in enumerate(columns)
        if axis == axis_name(model.key, model.channels[i], trace.episode.observations[model.key].shape[1])
    )
    place = next(places, None)
    if place is None or not has_true_starts(checkpoint):
        return True
    k, model, i, column = place
    readings = trace.episode.observations[model.key].copy()
    readings[:, model.channels[i]] += model.noise[i]
    changed = replace(trace.episode, observations={**trace.episode.observations, model.key: readings})
    steps, std = some_steps(trace, checkpoint), smallest_std(trace)
    runs = (run_from_truth(run, checkpoint, steps, std) for run in (trace, replace(trace, episode=changed)))
    before, after = (None if run is None else run.get("innovation") for run in runs)
    if before is None or after is None:
        return True
    gains = (after - before)[:, k, column] / model.noise[i]
    if not np.isfinite(gains).any():
        return True
    middle = float(np.nanmedian(gains))
    spread = float(np.nanmedian(np.abs(gains - middle)))
    return abs(middle - 1.0) < OWN_GAIN or spread < CONSTANT * abs(middle)


def _earlier(readings: Array, present: Mask, late: int) -> Array:
    """Readings (T, A) that came some readings before, at the steps with a reading; NaN where there is none."""
    steps, earlier = np.flatnonzero(present), np.full_like(readings, np.nan, dtype=np.float64)
    earlier[steps[late:]] = readings[steps[: len(steps) - late]]
    return earlier


def _outside(errors: Sequence[Array]) -> Array:
    """(A,) root mean square of errors (T, A) at two ends, 0 at steps where they have different signs."""
    first, last = errors
    outside = np.where(first * last > 0.0, np.minimum(np.abs(first), np.abs(last)), 0.0 * first)
    count = np.isfinite(outside).sum(0)
    return np.where(count < MIN_STEPS, np.nan, np.sqrt(np.nansum(np.square(outside), axis=0) / np.maximum(count, 1)))


def _lateness(errors: Array) -> tuple[int, Array]:
    """By how many readings the used ones are late, and the errors (A,) with these, from those of each number (L, A)."""
    largest = np.fmax.reduce(errors, axis=1)
    best = int(np.nanargmin(largest)) if np.isfinite(largest).any() else 0
    late = best if largest[best] < SAME and largest[0] > OTHER else 0
    return late, errors[late]


def _innovations_at_truth(trace: Trace) -> dict[str, float]:
    """``KIND/SUBJECT/all`` -> value, of the innovations of steps from true states.

    ``innovation spread``, by channel: their standard deviation. ``innovation offset``, by channel: their mean relative
    to it. ``innovation drift``, by channel: the change of a line through them over the episode, relative to their
    distance from it, as of a sensor that moves. ``innovation turns``, by modality: share of steps with about a full
    turn in a channel, also of networks, but not in units other than rad.
    """
    if trace.innovation is None:
        return {}
    values: dict[str, float] = {}
    channels = channels_of(trace, trace.innovation)
    for k, modality in enumerate(trace.modalities):
        at = np.isfinite(trace.innovation[:, k]).any(-1) & ~absent(trace, modality)
        if at.sum() < MIN_STEPS:
            continue
        nu, times = trace.innovation[at, k].astype(np.float64), np.flatnonzero(at) / len(at)
        for i in np.flatnonzero(np.isfinite(nu).all(0)).tolist():
            spread = max(float(nu[:, i].std()), 1e-12)
            name = f"{modality} {channels[k][i].name}"
            values[f"innovation offset/{name}/all"] = float(nu[:, i].mean()) / spread
            values[f"innovation spread/{name}/all"] = spread
            slope, level = np.polyfit(times, nu[:, i], 1)
            rest = max(float((nu[:, i] - slope * times - level).std()), 1e-12)
            values[f"innovation drift/{name}/all"] = float(slope) / rest
        may_be_angles = [channel.unit in ("", "1", "rad") for channel in channels[k]]
        turns = (_turned(column) for column, may_turn in zip(nu.T, may_be_angles, strict=False) if may_turn)
        values[f"innovation turns/{modality}/all"] = max(turns, default=0.0)
    return values


def _turned(nu: Array) -> float:
    """Share of innovations (S,) at true states of about a full turn, in a channel whose other ones are far smaller."""
    turned = np.abs(np.abs(nu) - TURN) < NEAR_TURN
    others = nu[~turned & np.isfinite(nu)]
    is_angle = len(others) >= MIN_STEPS and SEPARATE_TURN * float(np.sqrt(np.square(others).mean())) < TURN
    return float(turned.mean()) if is_angle else 0.0
