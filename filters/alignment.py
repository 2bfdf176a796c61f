"""Alignment of data whose state frame is shifted by a constant offset from that of a checkpoint's training data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task
from beliefscope.filters.batch import Steps
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.evaluate import run
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.out_of_distribution import findings

ITERATIONS = 3

MAX_SPREAD = 0.25
"""Largest spread of the offset between episodes, relative to its length, that counts as constant."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Alignment:
    """offset: (2,) m, added to the map components. moved: arrays that it was added to. spread: m, between episodes."""

    offset: Array
    moved: tuple[str, ...]
    spread: float

    def __str__(self) -> str:
        x, y = self.offset
        return f"moved {', '.join(self.moved)} by ({x:+z.3f}, {y:+z.3f}) m; the episodes differ by {self.spread:.3f} m"


def move(task: Task, episode: Episode, offset: Array, keys: Sequence[str]) -> Episode:
    """The episode with the map components, and the positions of these keys (``Task.positions``), moved by an offset."""

    def moved(values: NDArray[np.float32], indices: Sequence[int]) -> NDArray[np.float32]:
        values = values.copy()
        values[:, list(indices)] += offset.astype(np.float32)
        return values

    observations = dict(episode.observations)
    for key in keys:
        if key in observations:
            observations[key] = moved(observations[key], task.positions[key])
    controls = moved(episode.controls, task.positions["control"]) if "control" in keys else episode.controls
    return replace(
        episode, states=moved(episode.states, task.map_indices), controls=controls, observations=observations
    )


def align(
    checkpoint: Checkpoint, episodes: Sequence[Episode], particles: int = 300, seed: int = 0
) -> tuple[list[Episode], Alignment | None]:
    """Episodes moved into the frame of the training data; None if their positions do not differ from it.

    The first offset is the difference of the means. It is then corrected by the filter's own mean error, the median
    over episodes: images are in the frame of the training data. The end effector moves too if that brings its positions
    nearer to those of the training data.

    Raises:
        BadInput: a constant offset does not explain the difference, or the filter is external and has no statistics.
    """
    if isinstance(checkpoint, ExternalFilter):
        raise BadInput(f"{checkpoint.source} is an external filter: its training data are unknown, so it cannot align")
    task, statistics = checkpoint.task, checkpoint.filter.statistics
    units = {finding.channel.unit for finding in findings(checkpoint, episodes) if finding.channel.group == "state"}
    if "m" not in units:
        return list(episodes), None
    indices = list(task.map_indices)
    mean = statistics.mean_std("state")[0].cpu().numpy()[indices].astype(float)
    offset = mean - np.mean([episode.states[:, indices].mean(0) for episode in episodes], axis=0)
    keys = [key for key in task.positions if _nearer(checkpoint, episodes, offset, key)]
    for _ in range(ITERATIONS):
        residuals = _mean_errors(checkpoint, [move(task, e, offset, keys) for e in episodes], particles, seed)
        offset = offset + np.median(residuals, axis=0)
    deviation = residuals - np.median(residuals, axis=0)
    spread = float(np.sqrt(np.median(np.square(deviation).sum(1))))
    aligned = [move(task, episode, offset, keys) for episode in episodes]
    remaining = [f for f in findings(checkpoint, aligned) if f.channel.group == "state" and f.channel.unit == "m"]
    if remaining or spread > MAX_SPREAD * float(np.linalg.norm(offset)):
        raise BadInput(f"no constant offset aligns the data: the best, {offset.round(3)} m, varies by {spread:.3f} m")
    return aligned, Alignment(offset, ("state", *keys), spread)


def _nearer(checkpoint: Checkpoint, episodes: Sequence[Episode], offset: Array, key: str) -> bool:
    """Whether the offset brings the mean position of an array nearer to the mean of the training data."""
    task, statistics = checkpoint.task, checkpoint.filter.statistics
    channels = list(task.positions[key])
    if key == "control":
        arrays, first, group = [episode.controls for episode in episodes], 0, key
    else:
        group, keys = next((name, keys) for name, keys in task.modalities.items() if key in keys)
        arrays = [episode.observations[key] for episode in episodes]
        first = sum(task.observations[other][0] for other in keys[: keys.index(key)])
    mean = statistics.mean_std(group)[0].cpu().numpy()[[first + channel for channel in channels]]
    difference = np.mean([array[:, channels].mean(0) for array in arrays], axis=0) - mean
    return bool(np.linalg.norm(difference + offset) < np.linalg.norm(difference))


def _mean_errors(checkpoint: Checkpoint, episodes: Sequence[Episode], particles: int, seed: int) -> Array:
    """(R, map components) mean error of the estimate on the map in each episode, m, without the first steps."""
    filter_ = checkpoint.filter
    steps = Steps.from_episodes(filter_.task, episodes)
    lengths = steps.length.numpy()
    errors = np.zeros((len(episodes), len(filter_.task.map_indices)))
    for length in np.unique(lengths):
        members = np.flatnonzero(lengths == length)
        error, _ = run(filter_, steps.windows(steps.first[members], int(length)), None, particles, seed)
        late = error[filter_.task.first_counted(int(length)) :, :, list(filter_.task.map_indices)]
        errors[members] = late.mean(0).numpy()
    return errors
