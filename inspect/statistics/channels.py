"""Channels of a trace over time, with their names and units: readings, residuals, controls and innovations."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.task import Component
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.innovations import channels_of, reported_innovations
from beliefscope.inspect.traces.data import Trace

MAX_CHANNELS = 16
"""Largest number of channels of a sensor or an innovation that has columns; more, as those of a lidar, are no chart."""

FloatArray = NDArray[np.floating[Any]]


def reading_channels(trace: Trace) -> dict[str, tuple[FloatArray, list[Component]]]:
    """Column -> readings (T, d) of a vector sensor as the filter received them, or the controls, and their channels.

    NaN at steps without a reading. Scans, which are drawn, and vectors of more than ``MAX_CHANNELS`` have no column.
    """
    task, episode = trace.task, trace.episode
    result = {}
    for key, values in {**episode.observations, "control": episode.controls}.items():
        if values.ndim == 2 and 1 <= values.shape[1] <= MAX_CHANNELS and key not in task.scans:
            present = episode.present(key)[:, None]
            channels = [task.channel(key, i) for i in range(values.shape[1])]
            result[f"readings/{key}"] = (np.where(present, values, np.nan).astype(np.float32), channels)
    return result


def residual_channels(trace: Trace) -> dict[str, tuple[FloatArray, list[Component]]]:
    """Column -> readings (T, d) of a sensor minus the true state, of channels that measure a component.

    Channels of the task's own sensors have the name and the unit of that component: ``gps x`` in m of ``x``. NaN
    without a reading or truth; none without any truth; angles are wrapped. Components of rotations have no residuals.
    """
    task, states = trace.task, trace.episode.states
    indices = {(c.name, c.unit): i for i, c in enumerate(task.components) if not c.rotation}
    result = {}
    for column, (values, channels) in reading_channels(trace).items():
        key = column.removeprefix("readings/")
        if key not in task.channels or key == "control":
            continue
        components = [indices.get((channel.name.removeprefix(f"{key} "), channel.unit), -1) for channel in channels]
        measured, at = np.array(states), [i for i in components if i >= 0]
        measured[:, at] = values[:, [i >= 0 for i in components]]
        residuals = task.difference(measured, states)[:, at].astype(np.float32)
        if np.isfinite(residuals).any():
            names = [channel.name for channel, i in zip(channels, components, strict=True) if i >= 0]
            own = [replace(task.components[i], name=name) for i, name in zip(at, names, strict=True)]
            result[f"residual/{key}"] = residuals, own
    return result


def innovation_channels(trace: Trace) -> dict[str, tuple[FloatArray, list[Component]]]:
    """Column -> innovation of a modality (T, d) in the space of its measurements, or its standard deviation.

    NaN without a measurement; empty if the filter does not report them.
    """
    if (pair := reported_innovations(trace)) is None:
        return {}
    innovation, deviations = pair[0], measures.deviations(pair[1])
    result = {}
    for k, (modality, channels) in enumerate(zip(trace.modalities, channels_of(trace, innovation), strict=True)):
        if not np.isfinite(innovation[:, k, MAX_CHANNELS:]).any():
            for name, values in (("innovation", innovation), ("innovation_sigma", deviations)):
                # The width does not depend on the steps, so that those of blocks of a live run agree.
                result[f"{name}/{modality}"] = (values[:, k, :MAX_CHANNELS], channels[:MAX_CHANNELS])
    return result
