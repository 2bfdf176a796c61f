"""Statistics of an episode's readings and controls without ground truth, compared with a healthy profile.

Named ``KIND/SUBJECT/PHASE`` like all statistics of a profile; NaN where one is not defined.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from beliefscope.datasets.episode import Episode, is_image, lost_images
from beliefscope.inspect.diagnosis.checks.controls import law_statistics
from beliefscope.inspect.diagnosis.checks.images import (
    brightness_of,
    frozen_images,
    image_statistics,
    motion_statistics,
)
from beliefscope.inspect.diagnosis.checks.label_shift import label_shift_statistics
from beliefscope.inspect.diagnosis.checks.readings import (
    biased_interval,
    reading_statistics,
    with_errors,
    without_outliers,
)
from beliefscope.inspect.diagnosis.checks.vectors import (
    angle_channels,
    axis_index,
    contact_changes,
    contact_distance_statistics,
    free_motion,
    saturated,
    stuck,
    vector_statistics,
)
from beliefscope.inspect.diagnosis.checks.windows import (
    EXTREME,
    RANGE,
    deviating_windows,
    window_statistics,
    window_values,
)
from beliefscope.inspect.diagnostics.statistic_kinds import AROUND_EXPECTED, sensor_of
from beliefscope.inspect.statistics.array_channels import element_statistics, with_array_channels
from beliefscope.inspect.statistics.reading_model import ReadingModel
from beliefscope.inspect.statistics.reference_images import Reference, image_keys, with_gray_images
from beliefscope.inspect.statistics.signals import MIN_STEPS, Array, Mask, deviating_interval, long_runs, repeats

SMOOTH = 9
"""Steps whose median is the size of the noise of a vector sensor: single differences of few channels vary by chance."""

CONTRAST = {"level": 0.3, "noise": 0.7, "position noise": 0.7, "brightness": 0.5}
"""Kind of statistic -> largest size of its deviation in the other steps, relative to the affected ones."""


def sensor_statistics(
    episode: Episode, reference: Reference | None, readings: Sequence[ReadingModel] = ()
) -> dict[str, float]:
    """All statistics of sensors and controls; some of images only with a reference, of others only with a model."""
    values = element_statistics(episode)
    episode = with_array_channels(with_gray_images(with_continuous_angles(episode)))
    for key in image_keys(episode):
        values |= image_statistics(episode, key, reference) | motion_statistics(episode, key, reference)
    values |= {f"absent/{key}/all": float(1.0 - episode.present(key).mean()) for key in episode.task.masks}
    values |= reading_statistics(episode, readings) | label_shift_statistics(episode, readings)
    episode = without_outliers(episode, readings)  # a window of few readings has their noise
    values |= vector_statistics(episode) | law_statistics(episode)
    values |= contact_distance_statistics(episode, reference) | window_statistics(episode, reference)
    # A flag that is stuck from a step in contact has the readings of one that is inverted from there.
    ambiguous = contact_changes(episode) == 1
    return {name: np.nan if ambiguous and name.startswith("opposition/") else value for name, value in values.items()}


def with_continuous_angles(episode: Episode) -> Episode:
    """The episode with vector sensors whose angles, such as bearings, do not jump where they wrap around."""
    changed = {}
    for key, readings in episode.observations.items():
        if angles := angle_channels(episode, key):
            values, at = readings.astype(np.float64), np.ix_(episode.present(key), np.array(angles))
            values[at] = np.unwrap(values[at], axis=0)
            changed[key] = values
    return replace(episode, observations={**episode.observations, **changed}) if changed else episode


def localise(
    statistic: str,
    episode: Episode,
    reference: Reference | None,
    healthy: float | None = None,
    models: Sequence[ReadingModel] = (),
) -> tuple[int, int] | None:
    """First and last step that a statistic of sensors is about; None if it has no steps, such as a lag.

    Lost, repeated and saturated readings are marked step by step; of noise, level, exposure and errors against the
    expected readings it is the interval that differs most from the rest of the episode; of other statistics of
    windows, the most deviating windows.

    Args:
        healthy: value of the statistic in a window; None if unknown.
        models: of the expected readings.
    """
    kind, subject, phase = statistic.split("/")
    if kind == "reading bias":
        return biased_interval(subject, episode, models)
    key, axis = sensor_of(subject, episode.observations)
    if key not in episode.observations:
        return None
    episode = with_continuous_angles(episode)
    episode = with_gray_images(episode) if key in episode.task.images else episode
    episode = with_array_channels(episode) if axis else episode
    marked = _marked_steps(kind, key, axis, episode)
    if marked is not None:
        steps = np.flatnonzero(marked)
        return (int(steps[0]), int(steps[-1])) if len(steps) else None
    if kind == "level":
        return biased_steps(episode, key, axis_index(axis))
    if phase in AROUND_EXPECTED:
        episode = with_errors(episode, [model for model in models if model.key == key])
    sizes = _sizes(kind, key, axis, episode, reference)
    if sizes is not None:
        return _interval(sizes, kind)
    if phase not in (EXTREME, RANGE):
        return None
    windows = window_values(episode, reference)
    values = next((v for name, v in windows.items() if name.startswith(f"{kind}/{subject}/")), None)
    return None if values is None or not np.isfinite(values).any() else deviating_windows(values, healthy)


def covers_episode(statistic: str, episode: Episode) -> bool:
    """Whether all readings of an episode are lost images, or the same reading, if a statistic counts such readings."""
    kind, subject, _ = statistic.split("/")
    key, axis = sensor_of(subject, episode.observations)
    if key not in episode.observations:
        return False
    readings = (with_array_channels(episode) if axis else episode).observations[key][episode.present(key)]
    match kind:
        case "black" | "losses":
            return bool(lost_images(readings).all())
        case "frozen" | "stuck":
            chosen = readings[:, axis_index(axis)] if axis else readings
            return bool((chosen == chosen[:1]).all())
    return False


def _marked_steps(kind: str, key: str, axis: str, episode: Episode) -> Mask | None:
    """(T,) affected steps of a statistic that counts steps; None for others."""
    readings, present = episode.observations[key], episode.present(key)
    match kind:
        case "black" | "losses":
            return lost_images(readings) & present
        case "frozen":
            return _in_runs(frozen_images(readings, episode.task.held_steps(key)), present)
        case "stuck" if axis:
            return _in_runs(stuck(episode, key, axis_index(axis)), present)
        case "stuck":
            return _in_runs(repeats(readings, episode.task.held_steps(key)), present)
        case "saturation" if axis:
            marked = np.zeros(len(present), dtype=bool)
            marked[present] = saturated(readings[present, axis_index(axis)].astype(np.float64))
            return marked
    return None


def biased_steps(episode: Episode, key: str, axis: int) -> tuple[int, int] | None:
    """First and last step with a large level in free motion; None if the other free steps have it as well.

    Contact hides a bias: at the first or the last step in free motion, the episode begins or ends with it.
    """
    free = np.flatnonzero(free_motion(episode) & episode.present(key))
    if len(free) < MIN_STEPS:
        return None
    steps = _interval(np.abs(episode.observations[key][free, axis].astype(np.float64)), "level")
    if steps is None:
        return None
    first, last = steps
    return int(free[first]) if first else 0, int(free[last]) if last < len(free) - 1 else len(episode) - 1


def _in_runs(mask: Mask, present: Mask) -> Mask:
    """(T,): steps with readings in long runs of the mask (T,), which steps without readings do not interrupt."""
    marked = np.zeros(len(mask), dtype=bool)
    marked[present] = long_runs(mask[present])
    return marked


def _without_lost(series: Array, readings: NDArray[Any]) -> Array:
    """A series (T,) interpolated at lost images and beside them, which have differences of their own."""
    if not is_image(readings):
        return series
    lost = np.convolve(lost_images(readings), np.ones(3))[1:-1] > 0.0
    steps = np.arange(len(series))
    return np.interp(steps, steps[~lost], series[~lost]) if not lost.all() else series


def _sizes(kind: str, key: str, axis: str, episode: Episode, reference: Reference | None) -> Array | None:
    """(T,) sizes of the deviation that a statistic measures; None if it has none."""
    readings, present = episode.observations[key].astype(np.float64), episode.present(key)
    match kind:
        case "noise" | "position noise" if present.sum() > 2:
            chosen = readings[:, [axis_index(axis)]] if axis else readings.reshape(len(readings), -1)
            middle = np.mean if key in episode.task.arrays else np.median  # of a tactile grid, most are at rest
            size = middle(np.abs(np.diff(chosen[present], n=2, axis=0)), axis=1)
            if not is_image(episode.observations[key]):  # the median of many pixels varies less
                size = median_filter(size, SMOOTH, mode="nearest")
            series = np.pad(size, 1, mode="edge") + max(1e-3 * size.max(), 1e-12)
            steps = np.arange(len(readings))
            return np.interp(steps, steps[present], _without_lost(series, episode.observations[key][present]))
        case "brightness" if reference is not None and reference.image.shape == readings.shape[1:]:
            return _without_lost(np.abs(brightness_of(readings, reference) - 1.0), episode.observations[key])
    return None


def _interval(sizes: Array, kind: str) -> tuple[int, int] | None:
    """First and last step of the interval with the largest sizes (T,); None if the other steps deviate as well."""
    first, last = deviating_interval(np.log(sizes) if "noise" in kind else sizes)  # noise varies by factors
    inside, others = sizes[first : last + 1], np.delete(sizes, np.s_[first : last + 1])
    return (first, last) if len(others) and np.median(others) <= CONTRAST[kind] * np.median(inside) else None
