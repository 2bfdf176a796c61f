"""Inputs of a run that a diagnosis changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from beliefscope.datasets.episode import Episode
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation


@dataclass(frozen=True)
class Setting:
    """Inputs of a run.

    Attributes:
        affected: episodes to which changes of sensors apply.
        steps: first affected step and first step after it; None for all.
    """

    checkpoint: Checkpoint
    episodes: Mapping[int, Episode]
    particles: int
    affected: frozenset[int]
    steps: tuple[int, int] | None = None


Deviations = Mapping[str, Deviation]
"""Statistic -> deviation."""
