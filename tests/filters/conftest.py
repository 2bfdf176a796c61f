"""Fixture of the filter tests: windows of random data."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

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
