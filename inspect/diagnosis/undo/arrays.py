"""Undoing a bias, a gain, a sign or an order of rows and columns of an array, by its healthy channels."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.inspect.diagnosis.undo.expected_readings import reading_model
from beliefscope.inspect.diagnosis.undo.run_inputs import Deviations, RunInputs, with_readings
from beliefscope.inspect.statistics.array_channels import CHANNELS, array_channels

ORDERS: Mapping[str, Callable[[NDArray[Any]], NDArray[Any]]] = {
    "as read": lambda values: values,
    "rows mirrored": lambda values: values[:, ::-1],
    "columns mirrored": lambda values: values[:, :, ::-1],
    "both mirrored": lambda values: values[:, ::-1, ::-1],
    "transposed": lambda values: values.swapaxes(1, 2),
}
"""Possible orders of the rows and columns of an array (T, H, W, ...)."""

CENTRE = (CHANNELS.index("row"), CHANNELS.index("column"))


def level(key: str, inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Values without the excess of their mean, over the healthy one or the one that the labels lead to expect."""
    mean = f"{key} {CHANNELS.index('mean')}"
    healthy = deviations.get(f"level/{mean}/free motion")
    error, model = deviations.get(f"reading bias/{mean}/all"), reading_model(key, inputs)
    if error is not None and model is not None:
        noise = dict(zip(model.channels, model.noise.tolist(), strict=True))
        excess = (error.value - error.healthy) * noise[CHANNELS.index("mean")]
    elif healthy is not None:
        excess = healthy.value - healthy.healthy
    else:
        return None
    return with_readings(inputs, key, lambda values, episode: values - excess)


def divide(key: str, inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Values divided by the ratio of their noise to the healthy one: a gain scales both alike."""
    noise = deviations.get(f"noise/{key}/all")
    if noise is None or not noise.value or not noise.healthy:
        return None
    gain = noise.value / noise.healthy
    return with_readings(inputs, key, lambda values, episode: values / gain)


def negate(key: str, inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Values with the opposite sign."""
    return with_readings(inputs, key, lambda values, episode: -values)


def reorder(key: str, inputs: RunInputs, deviations: Deviations) -> RunInputs | None:
    """Rows and columns in the order whose centres agree best with the labels; None if they have it."""
    model = reading_model(key, inputs)
    expected = [i for i, channel in enumerate(model.channels) if channel in CENTRE] if model is not None else []
    if model is None or not expected:
        return None
    channels, left = [model.channels[i] for i in expected], dict.fromkeys(ORDERS, 0.0)
    for episode in (inputs.episodes[index] for index in inputs.affected):
        shape, at = episode.observations[key].shape, model.compare(episode).present
        for name, order in ORDERS.items():
            values = order(episode.observations[key])
            errors = array_channels(values)[:, channels] - model.expected(episode)[:, expected]
            left[name] += np.inf if values.shape != shape else float(np.square(errors[at]).sum())
    best = min(left, key=lambda name: left[name])
    return None if best == "as read" else with_readings(inputs, key, lambda values, episode: ORDERS[best](values))
