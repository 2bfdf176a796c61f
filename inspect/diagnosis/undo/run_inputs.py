"""Inputs of a run that a diagnosis changes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import derived_controls
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.ablation import without
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile


@dataclass(frozen=True)
class RunInputs:
    """Inputs of a run.

    Attributes:
        affected: episodes to which changes of sensors apply.
        steps: first affected step and first step after it; None for all.
        healthy: profile that the run is compared with; None if no undo needs its reference.
    """

    checkpoint: Checkpoint
    episodes: Mapping[int, Episode]
    particles: int
    affected: frozenset[int]
    steps: tuple[int, int] | None = None
    healthy: HealthyProfile | None = None


Deviations = Mapping[str, Deviation]
"""Statistic -> deviation."""

Undo = Callable[[RunInputs, Deviations], RunInputs | None]
"""Returns the inputs without the fault; None if it cannot be undone."""


def without_sensor(inputs: RunInputs, external: ExternalFilter, modality: str) -> RunInputs | None:
    """The affected steps without information of a modality's sensors; None if no other modality remains."""
    if modality not in external.task.modalities or len(external.task.modalities) < 2:
        return None
    steps = slice(*(inputs.steps or (None,)))
    episodes = {
        index: without(episode, [modality], external.adapter.absent, steps) if index in inputs.affected else episode
        for index, episode in inputs.episodes.items()
    }
    return replace(inputs, episodes=episodes)


def with_readings(
    inputs: RunInputs, key: str, change: Callable[[NDArray[Any], Episode], NDArray[Any]]
) -> RunInputs | None:
    """Changed readings (T, ...) of a sensor, or controls, in the affected episodes; ``change`` also takes the episode.

    Controls that derive from the readings are recomputed, as when faults are injected.
    """
    episodes = dict(inputs.episodes)
    for index in inputs.affected:
        episode = episodes[index]
        if key == "control":
            controls = change(episode.controls, episode).astype(np.float32)
            episodes[index] = replace(episode, controls=controls)
            continue
        if key not in episode.observations:
            return None
        readings = episode.observations[key]
        changed = change(readings.astype(np.float64), episode)
        if readings.dtype == np.uint8:
            changed = np.rint(changed).clip(0, 255)
        observations = {**episode.observations, key: changed.astype(readings.dtype)}
        episodes[index] = replace(episode, observations=observations, controls=derived_controls(episode, observations))
    return replace(inputs, episodes=episodes)


def with_labels(inputs: RunInputs, change: Callable[[NDArray[Any]], NDArray[Any]]) -> RunInputs:
    """Changed true states (T, n) in the affected episodes."""
    episodes = {
        index: replace(episode, states=change(episode.states).astype(np.float32))
        if index in inputs.affected
        else episode
        for index, episode in inputs.episodes.items()
    }
    return replace(inputs, episodes=episodes)
