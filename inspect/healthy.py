"""Computation of healthy profiles from clean held-out episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.filter import Filter
from beliefscope.inspect.diagnosis.statistics import episode_statistics
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.statistics.reference_images import measure_reference
from beliefscope.inspect.traces.batch import trace_all

MAX_EPISODES = 120
"""Maximum number of episodes of a profile; more hardly change it."""


FOLDS = 4
"""Number of groups of episodes."""


def profile_of(checkpoint: Checkpoint, episodes: Sequence[Episode], data: str) -> HealthyProfile:
    """The healthy profile of a filter over clean episodes. ``data``: where they come from.

    Images are compared with a reference of the other groups of episodes, so that the statistics are those of new ones.
    """
    rows: list[dict[str, float]] = []
    particles = None
    groups = [[e for i, e in enumerate(episodes) if i % FOLDS != fold] for fold in range(FOLDS)]
    references = [measure_reference(group) for group in groups]
    for trace in trace_all(checkpoint, episodes, range(len(episodes))):
        rows.append(episode_statistics(trace, checkpoint, references[trace.episode_index % FOLDS]))
        particles = trace.particle_count
    names = dict.fromkeys(name for row in rows for name in row)
    columns = {name: np.array([row.get(name, np.nan) for row in rows]) for name in names}
    return HealthyProfile(data, len(rows), particles, columns, measure_reference(episodes))


def measure_profile(filter_: Filter, name: str, episodes: Sequence[Episode], data: str) -> dict[str, Any] | None:
    """JSON of the healthy profile of a trained filter over the held-out of the episodes; None if there are none."""
    held_out = [episode for episode in episodes if episode.split != "train"][-MAX_EPISODES:]
    if not held_out:
        return None
    return profile_of(Checkpoint(filter_, name, "", {}), held_out, data).to_json()
