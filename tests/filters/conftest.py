"""Fixtures of the filter tests: windows of random data, and short episodes of the sample data sets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
import torch

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.batch import Batch


def _window(steps: int, trajectories: int, seed: int = 0) -> Batch:
    """T steps of N trajectories with random values in the door task's shapes."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*size: int) -> torch.Tensor:
        return torch.randn(steps, trajectories, *size, generator=generator)

    images = torch.randint(256, (steps, trajectories, 32, 32), generator=generator, dtype=torch.uint8)
    states = 0.1 * normal(3).cumsum(0)
    observations = {"image": images, "haptics": normal(10)}
    return Batch(observations, normal(7), states, torch.zeros(steps, trajectories, dtype=torch.bool), states[0])


@pytest.fixture
def window() -> Callable[..., Batch]:
    return _window


def _short_episodes(task: str, indices: Sequence[int], steps: int) -> list[Episode]:
    def shorten(episode: Episode) -> Episode:
        arrays = {key: getattr(episode, key)[:steps] for key in ("states", "controls", "contact", "qpos")}
        observations = {key: value[:steps] for key, value in episode.observations.items()}
        return replace(episode, **arrays, observations=observations)

    with open_dataset(sample_path(task)) as dataset:
        return [shorten(dataset[index]) for index in indices]


@pytest.fixture(scope="session")
def short_episodes() -> Callable[[str, Sequence[int], int], list[Episode]]:
    """(task, indices, steps) -> the first steps of these episodes of the sample data set."""
    return _short_episodes
