"""Order, signs and delay of the channels of a user's sensors, against the readings that the labels lead to expect."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Task
from beliefscope.inspect.diagnosis.vector_checks import FORCE, TORQUE, axis_name
from beliefscope.inspect.statistics.reading_model import ReadingModel
from beliefscope.inspect.statistics.reference_images import CONTACT, HAND
from beliefscope.inspect.statistics.signals import Array, fitted_lag

MAX_CHANNELS = 24
"""Largest number of channels of a sensor whose channels are compared with each other."""

LARGEST = 0.9999
"""Largest correlation of which the rest is computed."""


def modelled_sensors(task: Task) -> list[str]:
    """Observation keys of the vector sensors of unknown physics, except lidars.

    A measured hand shows the physics of force and torque.
    """
    known = {CONTACT, *task.scans, *((HAND, FORCE, TORQUE) if HAND in task.observations else ())}
    sizes = {key: shape[0] for key, shape in task.observations.items() if len(shape) == 1 and key not in known}
    return [key for key, size in sizes.items() if size <= MAX_CHANNELS]


def reading_statistics(episode: Episode, models: Sequence[ReadingModel]) -> dict[str, float]:
    """Of each channel that the labels explain, from the correlations c of readings with expected readings.

    ``inverted``: -c, 0 if positive. ``exchanged``: half the log-ratio of 1 - |c|, summed over two channels, to that
    with these channels exchanged, for the best other channel; 0 if none is better. Gain and bias do not matter.
    ``reading lag``: steps by which the readings of a sensor follow the expected ones; c is that at this lag.
    ``reading bias``: mean difference from the expected readings, in healthy standard deviations within episodes.
    """
    values: dict[str, float] = {}
    for model in models:
        if model.key not in episode.observations or not np.isfinite(episode.states).all():
            continue
        delay, correlation = delayed_correlations(episode, model)
        readings, expected, present = model.compare(episode)
        bias = (
            (readings[present] - expected[present]).mean(0) / model.scales if present.any() else model.scales * np.nan
        )
        values[f"reading lag/{model.key}/all"] = delay
        own, size = np.diagonal(correlation), np.minimum(np.abs(correlation), LARGEST)
        rest = 2.0 - np.diagonal(size)[:, None] - np.diagonal(size)
        evidence = 0.5 * np.log(rest / (2.0 - size - size.T))
        count = episode.task.observations[model.key][0]
        for i, channel in enumerate(model.channels):
            axis = axis_name(model.key, channel, count)
            values[f"reading bias/{axis}/all"] = float(bias[i])
            values[f"inverted/{axis}/all"] = max(0.0, -float(own[i]))
            if len(model.channels) > 1:
                values[f"exchanged/{axis}/all"] = max(0.0, float(np.delete(evidence[i], i).max()))
    return values


def delayed_correlations(episode: Episode, model: ReadingModel) -> tuple[float, Array]:
    """Delay of the readings in steps, NaN if they do not follow the expected ones, and correlations (A, A).

    The correlations are those at the delay.
    """
    delay = fitted_lag(*model.compare(episode))
    return delay, model.correlations(episode, 0 if np.isnan(delay) else int(delay))
