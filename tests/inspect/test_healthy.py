"""Healthy records and the episodes that are compared with them."""

from __future__ import annotations

import pytest

import beliefscope as bs
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.unavailable import UnavailableFilter
from beliefscope.inspect.diagnosis.diagnose import required_profile
from beliefscope.inspect.healthy import overlap_warning


def test_diagnosed_episodes_in_the_healthy_record_are_counted() -> None:
    with open_dataset(sample_path("door")) as data:
        episodes = [data[index] for index in range(4)]
    diagnosed = episodes[2:]
    assert overlap_warning(episodes[:2], diagnosed) is None
    assert "contains 1 of the 2 diagnosed episodes" in str(overlap_warning(episodes[:3], diagnosed))
    assert "contains 1 of the 1 diagnosed episodes" in str(overlap_warning(2 * episodes[:1], 2 * episodes[:1]))


@pytest.mark.parametrize(
    ("checkpoint", "command"),
    [
        (UnavailableFilter("live", "", DOOR), "diagnose DIR --profile-from HEALTHY_DIR"),
        (
            bs.load_filter("examples/04_own_filter.py:build"),
            "diagnose door --filter examples/04_own_filter.py:build --data DATA",
        ),
    ],
)
def test_the_command_for_a_healthy_record_names_a_filter_that_it_can_open(checkpoint: Checkpoint, command: str) -> None:
    with pytest.raises(BadInput, match=f"beliefscope {command}"):
        required_profile(checkpoint)
