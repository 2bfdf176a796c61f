"""Inputs of a run that a diagnosis changes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from beliefscope.datasets.episode import Episode
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
