"""Arrays and point clouds as few channels that the labels may explain as those of vectors.

The sensors' physics are unknown: a depth image has an object at some place, a tactile grid a contact, a spectrogram a
loudness. Their mean and spread show a bias and a gain, and their centre a mirrored or transposed array. Of a point
cloud, whose rows have no order, the centre shows a moved sensor, and centre and spread a wrong unit.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Task
from beliefscope.inspect.statistics.signals import Array, noise_level, repeats

CHANNELS = ("mean", "spread", "row", "column")
"""Channels of an array: mean and standard deviation of its elements, and the centre along its first two axes."""

CLOUD_CHANNELS = ("x", "y", "z", "spread")
"""Channels of a point cloud: centre, without z of points in a plane, and root mean square distance from it."""

MAX_ELEMENTS = 10_000
"""Largest number of elements that all count. Larger arrays count by every second row and column, and so on."""


def array_keys(task: Task) -> list[str]:
    """Observation keys of arrays (H, W, ...) of numbers, other than point clouds, whose rows have no order."""
    return [key for key in task.arrays if len(task.observations[key]) > 1]


def channel_names(task: Task, key: str) -> tuple[str, ...]:
    """Names of the channels of an array or a point cloud; none for other sensors."""
    if key in task.clouds:
        return CLOUD_CHANNELS if task.observations[key][1] > 2 else (*CLOUD_CHANNELS[:2], CLOUD_CHANNELS[-1])
    return CHANNELS if key in array_keys(task) else ()


def reading_channels(task: Task, key: str, readings: NDArray[Any]) -> Array:
    """(T, d) readings of a vector sensor, or channels of an array or a point cloud."""
    if readings.ndim < 3:
        return readings.astype(np.float64)
    return cloud_channels(readings) if key in task.clouds else array_channels(readings)


def cloud_channels(readings: NDArray[Any]) -> Array:
    """(T, 3) or (T, 4) ``CLOUD_CHANNELS`` of points (T, P, c); those of the step before where all points are absent."""
    points = readings[..., :3].astype(np.float64)
    present = (points != 0.0).any(-1)
    count = np.maximum(present.sum(1), 1)[:, None]
    centre = (points * present[..., None]).sum(1) / count
    distance = np.square(points - centre[:, None]).sum(-1) * present
    result = np.concatenate([centre, np.sqrt(distance.sum(1, keepdims=True) / count)], axis=1)
    last = np.maximum.accumulate(np.where(present.any(1), np.arange(len(result)), 0))
    return np.asarray(result[last])


def array_channels(readings: NDArray[Any]) -> Array:
    """(T, 4) ``CHANNELS`` of arrays (T, H, W, ...); the centre in elements from the middle, so mirroring negates it.

    The elements' squared distances from their median are the weights of the centre: a peak counts, or a hole, but
    hardly the noise of the others. It is 0 for an array of equal elements.
    """
    values, stride = _thinned(readings)
    flat = values.reshape(len(values), -1)
    weights = np.square(values - np.median(flat, axis=1).reshape(-1, *[1] * (values.ndim - 1)))
    centres = []
    for axis in (1, 2):
        others = tuple(i for i in range(1, values.ndim) if i != axis)
        along, count = weights.sum(axis=others), values.shape[axis]
        total, places = along.sum(1), stride * (np.arange(count) - 0.5 * (count - 1))
        centres.append((along @ places) / np.where(total > 0.0, total, 1.0))
    return np.stack([flat.mean(1), flat.std(1), *centres], axis=1)


def _thinned(readings: NDArray[Any]) -> tuple[Array, int]:
    """Arrays (T, H, W, ...) of at most ``MAX_ELEMENTS`` each, and how many rows and columns are one of theirs."""
    stride = math.ceil(math.sqrt(readings[0].size / MAX_ELEMENTS))
    rows, columns = ((size - 1) % stride // 2 for size in readings.shape[1:3])  # as far from both borders
    return readings[:, rows::stride, columns::stride].astype(np.float64), stride


def with_array_channels(episode: Episode) -> Episode:
    """The episode with vectors of their channels in place of its arrays and point clouds."""
    task, readings = episode.task, episode.observations
    changed = {key: reading_channels(task, key, readings[key]) for key in (*array_keys(task), *task.clouds)}
    return replace(episode, observations={**episode.observations, **changed}) if changed else episode


def element_statistics(episode: Episode) -> dict[str, float]:
    """Statistics of the elements of arrays and points of clouds in an episode; none of steps without a reading.

    ``noise`` and ``size``: mean over the elements of their noise and of their standard deviation, and ``roughness``,
    their ratio. ``stuck``: share of steps that repeat the whole array. ``dead``: share of elements that never change,
    other than those at the largest value, which are saturated. ``saturation``: share of readings at this value.
    ``holes``: share of readings that are 0, such as those of a depth image without a return, or of absent points.
    """
    values = _point_statistics(episode)
    for key in array_keys(episode.task):
        present, (all_readings, _) = episode.present(key), _thinned(episode.observations[key])
        if present.sum() < 3:
            continue
        readings, noise = all_readings[present], float(noise_level(all_readings, present).mean())
        size, largest, constant = float(readings.std(0).mean()), readings.max(), (readings == readings[:1]).all(0)
        held = repeats(episode.observations[key], episode.task.held_steps(key))
        values |= {
            f"noise/{key}/all": noise,
            f"size/{key}/all": size,
            f"roughness/{key}/all": noise / size if size > 0.0 else np.nan,
            f"stuck/{key}/all": float(held[present].mean()),
            f"dead/{key}/all": float((constant & (readings[0] < largest)).mean()),
            f"saturation/{key}/all": float((readings == largest).mean()),
            f"holes/{key}/all": float((readings == 0.0).mean()),
        }
    return values


def _point_statistics(episode: Episode) -> dict[str, float]:
    values: dict[str, float] = {}
    for key in episode.task.clouds:
        points, present = episode.observations[key], episode.present(key)
        if present.any():
            held = repeats(points, episode.task.held_steps(key))
            values[f"stuck/{key}/all"] = float(held[present].mean())
            values[f"holes/{key}/all"] = float((points[present, :, :3] == 0.0).all(-1).mean())
    return values
