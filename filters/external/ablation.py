"""Ablation of sensors: the episode that an external filter sees without some of its modalities."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import check_name


def without(
    episode: Episode,
    modalities: Collection[str],
    absent: Literal["mean", "nan"],
    steps: slice = slice(None),
) -> Episode:
    """The episode without the readings of some modalities. Raises BadInput for an unknown modality.

    Args:
        absent: what replaces them: the mean of each channel or pixel over the episode, which is a sensor that carries
            no information about a step; or NaN, and black images.
        steps: affected steps.
    """
    task = episode.task
    for modality in modalities:
        check_name(f"modality of task {task.name!r}", modality, task.modalities)
    observations, covariates = dict(episode.observations), dict(episode.covariates)
    for key in {key for modality in modalities for key in task.modalities[modality]}:
        if key in observations:
            readings = observations[key].copy()
            readings[steps] = _neutral(readings, absent)
            observations[key] = readings
        if key in task.masks:
            present = episode.present(key).astype(np.float32)
            present[steps] = 0.0
            covariates[task.masks[key]] = present
    return replace(episode, observations=observations, covariates=covariates)


def with_only(episode: Episode, modalities: Collection[str] | None, absent: Literal["mean", "nan"]) -> Episode:
    """The episode with the readings of some modalities only, or of all (None). absent: as in ``without``."""
    others = [] if modalities is None else [name for name in episode.task.modalities if name not in modalities]
    return without(episode, others, absent)


def _neutral(readings: NDArray[Any], absent: Literal["mean", "nan"]) -> Any:
    """Reading (...) without information, of readings (T, ...)."""
    if absent == "nan":
        return np.nan if readings.dtype.kind == "f" else 0
    is_finite = np.isfinite(readings)
    total = np.where(is_finite, readings, 0).sum(0, dtype=np.float64)
    mean = total / np.maximum(is_finite.sum(0), 1)
    return mean if readings.dtype.kind == "f" else np.rint(mean)
