"""Undoing a bias, a drift, a gain or another order of channels, by the readings that the healthy record expects."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.inspect.diagnosis.checks.readings import delayed_errors
from beliefscope.inspect.diagnosis.checks.sensors import biased_steps
from beliefscope.inspect.diagnosis.checks.vectors import free_motion
from beliefscope.inspect.diagnosis.undo.run_inputs import Deviations, RunInputs, with_readings
from beliefscope.inspect.statistics.array_channels import channel_names
from beliefscope.inspect.statistics.reading_model import ReadingModel
from beliefscope.inspect.statistics.signals import MIN_STEPS, Array, wrapped

SMALLEST_GAIN = 0.01
"""Smallest slope of readings on the expected ones by which they are divided."""


def tare(key: str, inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Force or torque without its excess level in free motion; that of some steps only is removed from these.

    Other vector sensors without their mean error from the expected readings.
    """
    if channel_names(inputs.checkpoint.task, key):
        return None
    levels = [deviations.get(f"level/{key} {axis}/free motion") for axis in "xyz"]
    if None in levels:
        model = _vector_model(key, inputs, weak=True)
        return _as_expected(model, inputs, lambda readings, expected: np.ones(readings.shape[1]))

    def unbiased(readings: NDArray[Any], episode: Episode) -> NDArray[Any]:
        free = free_motion(episode) & episode.present(key)
        for axis, level in enumerate(levels[: readings.shape[1]]):
            assert level is not None
            steps = biased_steps(episode, key, axis)
            if steps is None:
                readings[:, axis] -= level.value - level.healthy
            else:
                part = np.s_[steps[0] : steps[1] + 1]
                readings[part, axis] -= np.median(readings[part, axis][free[part]]) - level.healthy
        return readings

    return with_readings(inputs, key, unbiased)


def detrend(key: str, inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Readings without the line over time that fits their errors from the expected ones in all affected episodes."""
    if (model := _vector_model(key, inputs)) is None:
        return None
    compared = [model.compare(inputs.episodes[index]) for index in inputs.affected]
    steps = np.concatenate([one.steps() for one in compared])
    errors = np.concatenate([np.subtract(*one.pairs()) for one in compared])
    if len(steps) < MIN_STEPS:
        return None
    slope, offset = np.polyfit(steps, errors, 1)
    return _with_channels(inputs, model, lambda own: own - offset - slope * np.arange(len(own))[:, None])


def scale(key: str, inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Readings without their mean error from the expected ones, and divided by their slope on these."""

    def slope(readings: Array, expected: Array) -> Array:
        around = expected - expected.mean(0)
        return np.asarray((around * readings).sum(0) / np.maximum(np.square(around).sum(0), 1e-24))

    return _as_expected(_vector_model(key, inputs), inputs, slope)


def rearrange(key: str, inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Readings with the order and the signs of channels that best agree with the labels; None if they have them."""
    if (model := _vector_model(key, inputs)) is None:
        return None
    from scipy.optimize import linear_sum_assignment  # takes most of a second

    affected = (inputs.episodes[index] for index in inputs.affected)
    total = np.sum([delayed_errors(model.compare(episode), episode.dt)[1] for episode in affected], axis=0)
    if not np.isfinite(total).all():
        return None
    sources, channels = linear_sum_assignment(total.min(0))  # reading i is of channel j
    signs = np.where(total.argmin(0)[sources, channels], -1.0, 1.0)
    if (sources == channels).all() and (signs > 0.0).all():
        return None
    order = np.array(model.channels)

    def arranged(values: NDArray[Any], episode: Episode) -> NDArray[Any]:
        result = values.copy()
        result[:, order[channels]] = signs * values[:, order[sources]]
        return result

    return with_readings(inputs, key, arranged)


def _as_expected(
    model: ReadingModel | None, inputs: RunInputs, gain_of: Callable[[Array, Array], Array]
) -> RunInputs | None:
    """Readings (z - c) / g, which agree with the expected ones in the mean of the affected episodes.

    None without a model of the sensor, and for a gain of about 0.

    Args:
        gain_of: g (A,) from readings and expected readings (S, A).
    """
    if model is None:
        return None
    pairs = (model.compare(inputs.episodes[index]).pairs() for index in inputs.affected)
    readings, expected = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    gain = gain_of(readings, expected) if len(readings) >= MIN_STEPS else np.zeros(1)
    if (np.abs(gain) < SMALLEST_GAIN).any():
        return None
    offset = readings.mean(0) - gain * expected.mean(0)
    return _with_channels(inputs, model, lambda own: (own - offset) / gain)


def _with_channels(inputs: RunInputs, model: ReadingModel, change: Callable[[Array], Array]) -> RunInputs | None:
    """Changed readings (T, A) of the channels of a sensor that have a model; angles are wrapped."""
    channels = list(model.channels)

    def restored(values: NDArray[Any], episode: Episode) -> NDArray[Any]:
        result, own = values.copy(), change(values[:, channels])
        result[:, channels] = np.where(model.is_angle, wrapped(own), own)
        return result

    return with_readings(inputs, model.key, restored)


def reading_model(key: str, inputs: RunInputs, weak: bool = False) -> ReadingModel | None:
    """The healthy record's model of a sensor; None if the labels explain none of its channels.

    weak: with channels that they explain in part only.
    """
    readings = () if inputs.healthy is None else inputs.healthy.readings
    models = (model.with_weak_channels() if weak else model for model in readings if model.key == key)
    return next((model for model in models if model.channels), None)


def _vector_model(key: str, inputs: RunInputs, weak: bool = False) -> ReadingModel | None:
    """The same of a vector sensor; None for arrays and point clouds, whose channels are no readings."""
    return None if channel_names(inputs.checkpoint.task, key) else reading_model(key, inputs, weak)
