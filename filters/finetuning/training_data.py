"""Training episodes of a fine-tuning run: those of the data set, or simulated ones for a sample set that has none."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from beliefscope.datasets.dataset import Dataset, no_training_episodes
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset

EPISODES, SEED = 60, 1000
"""Number of simulated episodes, and the seed of their random numbers, which no sample set has."""


def simulated_episodes(name: str, data: Dataset, is_sample: bool) -> int:
    """Number of episodes to simulate for a fine-tuning run; 0 if the data set has training episodes.

    Raises BadInput if it has none and is not the sample set of a task that can be simulated.
    """
    if any(summary.split == "train" for summary in data.summaries):
        return 0
    if not is_sample or data.task.simulate is None:
        raise no_training_episodes(data.task, (summary.split for summary in data.summaries), f"data set {name!r}")
    return EPISODES


def training_episodes(
    name: str, data: Dataset, is_sample: bool, folder: Path, progress: Callable[[int, int], None]
) -> tuple[list[Episode], str]:
    """The episodes of the data set, then simulated ones if it has none to train on; and the hash of all.

    Raises BadInput as ``simulated_episodes`` does. folder: for the simulated episodes, which are reused.
    """
    episodes = list(data)
    if not simulated_episodes(name, data, is_sample):
        return episodes, data.hash
    path = folder / f"{data.task.name}-train.h5"
    if not path.exists():
        _simulate(path, data, len(episodes[0]), progress)
    with closing(open_dataset(path)) as simulated:
        # Only episodes of the sample set are tested on.
        episodes += [replace(e, split="val") if e.split == "test" else e for e in simulated]
        return episodes, hashlib.sha256(f"{data.hash} {simulated.hash}".encode()).hexdigest()


def _simulate(path: Path, data: Dataset, steps: int, progress: Callable[[int, int], None]) -> None:
    from beliefscope.datasets.simulation.collect import collect  # imports MuJoCo

    path.parent.mkdir(parents=True, exist_ok=True)
    collect(data.task.name, EPISODES, steps, SEED, None, path, progress)
