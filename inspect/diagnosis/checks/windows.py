"""Extremes of sensor statistics over short windows of an episode: where a fault of a few steps shows.

A median over a complete episode ignores what lasts for less than half of it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.inspect.diagnosis.checks.images import image_statistics, is_usable, occluded_share
from beliefscope.inspect.diagnosis.checks.vectors import vector_statistics
from beliefscope.inspect.statistics.reference_images import Reference, image_keys
from beliefscope.inspect.statistics.signals import Array

LENGTH, STRIDE = 20, 10
"""Steps of a window, and steps from one to the next."""

MIN_WINDOWS = 3
"""Minimum number of windows with a value."""

EXTREME, RANGE = "extreme", "range"
"""Phases of the names of the statistics: the largest (of sharpness, the smallest) value, or the largest difference."""


def _difference(values: Array) -> float:
    return float(np.ptp(values))


def _ratio(values: Array) -> float:
    return float(values.max() / max(values.min(), 1e-3))


SUMMARIES: dict[str, tuple[str, Callable[[Array], float]]] = {
    "noise": (EXTREME, np.max),
    "position noise": (EXTREME, np.max),
    "occlusion": (EXTREME, np.max),
    "opposition": (EXTREME, np.max),
    "roughness": (EXTREME, np.max),
    "sharpness": (EXTREME, np.min),
    "clipped": (EXTREME, np.max),
    "brightness": (RANGE, _ratio),
    "shift": (RANGE, _difference),
    "hand offset": (RANGE, _difference),
    "level": (RANGE, _difference),
}
"""Kind of statistic -> phase, and summary of its values in the windows."""


def window_statistics(episode: Episode, reference: Reference | None) -> dict[str, float]:
    """``KIND/SUBJECT/extreme`` and ``KIND/SUBJECT/range`` of readings over windows of ``LENGTH`` steps."""
    result = {}
    for name, values in window_values(episode, reference).items():
        kind, subject, _ = name.split("/")
        finite = values[np.isfinite(values)]
        if kind in SUMMARIES and len(finite) >= MIN_WINDOWS:
            phase, summary = SUMMARIES[kind]
            result[f"{kind}/{subject}/{phase}"] = float(summary(finite))
    return result


def window_values(episode: Episode, reference: Reference | None) -> dict[str, Array]:
    """Statistic of a window -> its values (W,); NaN where it is not defined.

    The noise of images is relative to the largest exposure of the episode's windows, if above 1: an image that is dark
    for another reason has the noise of the camera's gain.
    """
    starts = window_starts(len(episode))
    rows = [_statistics(_part(episode, first), reference) for first in starts]
    names = dict.fromkeys(name for row in rows for name in row)
    values = {name: np.array([row.get(name, np.nan) for row in rows]) for name in names}
    for key in image_keys(episode):
        exposure = values.get(f"brightness/{key}/all", np.ones(1))
        if f"noise/{key}/all" in values and np.isfinite(exposure).any():
            values[f"noise/{key}/all"] /= max(1.0, float(np.nanmax(exposure)))
    return values


def window_starts(steps: int) -> range:
    """First steps of the windows of an episode."""
    return range(0, steps - LENGTH + 1, STRIDE)


def deviating_windows(values: Array, healthy: float | None = None) -> tuple[int, int] | None:
    """First and last step of the windows around the most deviating one of values (W,); None if all are equal.

    They deviate from the healthy value by at least half as much as it does; if that is unknown, from the median, which
    a fault of more than half of the windows would move.
    """
    distance = np.abs(values - (np.nanmedian(values) if healthy is None else healthy))
    if not np.nanmax(distance) > 0.0:
        return None
    most = int(np.nanargmax(distance))
    near = np.nan_to_num(distance) < 0.5 * distance[most]
    before, after = np.flatnonzero(near[:most]), np.flatnonzero(near[most:])
    first = before[-1] + 1 if len(before) else 0
    last = most + after[0] - 1 if len(after) else len(values) - 1
    start, end = int(first * STRIDE), int(last * STRIDE + LENGTH - 1)
    if first == last:
        return start, end
    # A window that a fault begins or ends in deviates by half, more or less.
    return start + STRIDE // 2 * bool(first), end - STRIDE // 2 * bool(last < len(values) - 1)


def _part(episode: Episode, first: int) -> Episode:
    steps = slice(first, first + LENGTH)
    observations = {key: values[steps] for key, values in episode.observations.items()}
    covariates = {name: values[steps] for name, values in episode.covariates.items()}
    return Episode(
        episode.task,
        episode.states[steps],
        observations=observations,
        contact=episode.contact[steps],
        dt=episode.dt,
        covariates=covariates,
    )


def _statistics(part: Episode, reference: Reference | None) -> dict[str, float]:
    values = vector_statistics(part)
    for key in image_keys(part):
        if is_usable(part.observations[key], part.present(key), part.task.held_steps(key)):
            values |= image_statistics(part, key, reference, gain=1.0)
            values |= occluded_share(part.observations[key], key, reference)
    return values
