"""Computation of healthy profiles from clean held-out episodes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.filter import Filter
from beliefscope.inspect.diagnosis.statistics import episode_statistics
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.batch import trace_all

MAX_EPISODES = 120
"""Maximum number of episodes of a profile; more hardly change it."""


def profile_of(checkpoint: Checkpoint, traces: Iterable[Trace], data: str) -> HealthyProfile:
    """The healthy profile of clean traces of a filter. ``data``: where their episodes come from."""
    rows: list[dict[str, float]] = []
    particles = None
    for trace in traces:
        rows.append(episode_statistics(trace, checkpoint))
        particles = None if trace.particles is None else trace.particles.shape[1]
    names = dict.fromkeys(name for row in rows for name in row)
    columns = {name: np.array([row.get(name, np.nan) for row in rows]) for name in names}
    return HealthyProfile(data, len(rows), particles, columns)


def measure_profile(filter_: Filter, name: str, episodes: Sequence[Episode], data: str) -> dict[str, Any] | None:
    """JSON of the healthy profile of a trained filter over the held-out of the episodes; None if there are none."""
    held_out = [episode for episode in episodes if episode.split != "train"][-MAX_EPISODES:]
    if not held_out:
        return None
    checkpoint = Checkpoint(filter_, name, "", {})
    return profile_of(checkpoint, trace_all(checkpoint, held_out, range(len(held_out))), data).to_json()
