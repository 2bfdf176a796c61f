"""Data standardised with their own statistics have zero mean and unit deviation; constant channels stay finite."""

from __future__ import annotations

from dataclasses import replace

import torch

from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.batch import Statistics, Steps


def test_data_are_standardised_by_their_own_statistics() -> None:
    with open_dataset(sample_path("door")) as data:
        steps = Steps.from_episodes(DOOR, [data[i] for i in range(6)])
    steps = replace(steps, controls=torch.cat([steps.controls[:, :6], torch.full_like(steps.controls[:, 6:], 3.0)], 1))
    statistics = Statistics(DOOR)
    statistics.fit(steps)
    for name, values in {"state": steps.states, **steps.observations}.items():
        standard = statistics.standardise(name, values).double()
        over = None if values.dtype == torch.uint8 else 0
        torch.testing.assert_close(standard.mean(over), torch.zeros_like(standard.mean(over)), atol=1e-3, rtol=0)
        torch.testing.assert_close(standard.std(over), torch.ones_like(standard.std(over)), atol=1e-3, rtol=0)
    assert torch.equal(statistics.standardise("control", steps.controls)[:, 6], torch.zeros(len(steps.controls)))
