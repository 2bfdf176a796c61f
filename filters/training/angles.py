"""Angles that wrap around in training data, which the built-in filters do not represent."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import display_name


def wrapping_warning(episodes: Sequence[Episode]) -> str | None:
    """One line about angles of the training episodes that jump by more than half a turn, or None.

    The networks and the updates of the built-in filters treat an angle as a number: dynamics and measurement models
    learn from a jump of a turn as from any other error.
    """
    training = [episode for episode in episodes if episode.split == "train"]
    lines = []
    for i, component in enumerate(training[0].task.components if training else ()):
        if component.unit != "rad" or component.rotation:
            continue
        jumps = sum(bool((np.abs(np.diff(episode.states[:, i])) > np.pi).any()) for episode in training)
        if jumps:
            lines.append(f"{display_name(component.name)} wraps around in {jumps} of {len(training)} training episodes")
    if not lines:
        return None
    return (
        f"{'; '.join(lines)}. Built-in filters treat angles as numbers, so that its errors will be large: use sine and "
        "cosine as components, a range without jumps, or an external filter (docs/own_filter.md)"
    )
