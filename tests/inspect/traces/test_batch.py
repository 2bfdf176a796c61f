"""Traces of many episodes of external filters, in batches."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.trace import Trace, trace
from beliefscope.inspect.traces.batch import trace_all

sys.path.insert(0, str(Path(__file__).parents[2] / "filters" / "external"))
import vehicle_filters as vehicle

LENGTHS = (40, 60, 40, 40, 60, 50, 40)
FAULTS = Faults.parse("sensor_bias=gps:offset=1")


class Counting(vehicle.TorchKalman):
    """Counts its calls; fails for a reading above a limit, adds noise to its estimate, or the mean of the batch."""

    def __init__(self, noise: float = 0.0, mixed: float = 0.0, limit: float = np.inf) -> None:
        super().__init__()
        self.noise, self.mixed, self.limit, self.calls = noise, mixed, limit, 0

    def forward(self, *, observations: dict[str, Tensor], controls: Tensor) -> tuple[Tensor, Tensor]:
        self.calls += 1
        if (observations["speed"] > self.limit).any():
            raise ValueError("too fast")
        mean, covariance = super().forward(observations=observations, controls=controls)
        mean = mean + self.mixed * mean.mean(0)
        return mean + self.noise * torch.randn_like(mean), covariance


def episodes() -> list[Episode]:
    return [vehicle.drive(seed, steps) for seed, steps in enumerate(LENGTHS)]


def external(filter_: Any) -> ExternalFilter:
    return ExternalFilter(Adapter(filter_, std=tuple(np.sqrt(10 * np.diag(vehicle.P0)))), vehicle.TASK, "mine")


def all_of(filter_: ExternalFilter, restart: bool = False) -> list[Trace]:
    return list(trace_all(filter_, episodes(), range(len(LENGTHS)), seed=3, faults=FAULTS, restart=restart))


@pytest.mark.parametrize("restart", [False, True])
def test_episodes_of_equal_length_run_in_batches_with_the_same_results(restart: bool) -> None:
    module = Counting()
    filter_ = external(module)
    runs, calls = all_of(filter_, restart), module.calls
    assert calls == 2 * min(LENGTHS) + sum(set(LENGTHS))  # once alone and once together first
    assert [run.episode_index for run in runs] == [*range(len(LENGTHS))]
    for index, (run, episode) in enumerate(zip(runs, episodes(), strict=True)):
        alone = trace(filter_, episode, index, 3, faults=FAULTS)
        assert (run.data_hash, run.faults, run.settings) == (alone.data_hash, alone.faults, alone.settings)
        np.testing.assert_array_equal(run.episode.observations["gps"], alone.episode.observations["gps"])
        for name in ("estimate_mean", "estimate_covariance", "start_mean", "start_covariance"):
            np.testing.assert_allclose(getattr(run, name), getattr(alone, name), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("module", [Counting(noise=0.1), Counting(mixed=0.01)])
def test_filters_with_random_numbers_or_dependent_episodes_run_one_by_one(module: Counting) -> None:
    filter_ = external(module)
    for index, (run, episode) in enumerate(zip(all_of(filter_), episodes(), strict=True)):
        np.testing.assert_array_equal(run.estimate_mean, trace(filter_, episode, index, 3, faults=FAULTS).estimate_mean)


def test_a_failing_episode_does_not_hide_those_before_it() -> None:
    fastest = [float(episode.observations["speed"].max()) for episode in episodes()]
    first = int(np.argmax(fastest))
    limit = sorted(fastest)[-2]
    runs = trace_all(external(Counting(limit=limit)), episodes(), range(len(LENGTHS)))
    assert [next(runs).episode_index for _ in range(first)] == [*range(first)]
    with pytest.raises(BadInput, match="too fast"):
        next(runs)
