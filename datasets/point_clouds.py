"""Points of lidar scans and point clouds, for drawing."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.task import Task

MAX_POINTS = 2000
"""Points per step that are drawn."""


def point_sensors(task: Task) -> tuple[str, ...]:
    """Observation keys of scans and point clouds, in the order of the observations."""
    return tuple(key for key in task.observations if key in task.scans or key in task.clouds)


def points_of(task: Task, key: str, readings: NDArray[Any]) -> NDArray[np.float32]:
    """(T, P, 3) m, in the frame of the sensor; NaN for absent points. At most ``MAX_POINTS``, evenly chosen.

    Args:
        readings: (T, d) ranges of a scan, or (T, P, c) points, whose third column, if any, is the height.
    """
    stride = -(-readings.shape[1] // MAX_POINTS)
    if key in task.scans:
        angle = np.linspace(*task.scans[key], readings.shape[1])[::stride]
        radius = np.where(readings[:, ::stride] > 0.0, readings[:, ::stride], np.nan)
        parts = (radius * np.cos(angle), radius * np.sin(angle), 0.0 * radius)
        points = np.stack(parts, axis=-1)
    else:
        chosen = readings[:, ::stride, :3]
        points = np.where((chosen != 0.0).any(-1, keepdims=True), chosen, np.nan)
        if points.shape[-1] == 2:
            points = np.concatenate([points, 0.0 * points[..., :1]], axis=-1)
    points = np.where(np.isfinite(points).all(-1, keepdims=True), points, np.nan)
    return points.astype(np.float32)


def extent_of(points: NDArray[np.float32]) -> float:
    """m: half the side of the square around the sensor that has 99 % of the points (T, P, 3), with a margin."""
    sides = np.abs(points[..., :2]).max(-1)
    sides = sides[np.isfinite(sides)]
    return 1.05 * float(np.percentile(sides, 99.0)) or 1.0 if len(sides) else 1.0
