"""Healthy records and the episodes that are compared with them."""

from __future__ import annotations

from dataclasses import replace

import pytest

import beliefscope as bs
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.unavailable import UnavailableFilter
from beliefscope.inspect.diagnosis.diagnose import required_profile
from beliefscope.inspect.diagnostics.healthy_comparison import no_diagnosis
from beliefscope.inspect.healthy import overlap_warning, sensor_record


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


def test_a_task_of_an_earlier_version_with_a_slash_in_a_name_has_no_diagnosis() -> None:
    """Statistics use the slash as a separator; files with such names open."""
    task = replace(DOOR, observations={"gps/fix": (2,)}, modalities={"gps": ("gps/fix",)})
    filter_ = UnavailableFilter("live", "", task)
    message = "observation 'gps/fix' has an invalid name, expected a text without /"
    assert f"{message}: rename it to diagnose its runs" in str(no_diagnosis(filter_))
    with pytest.raises(BadInput, match=message):
        required_profile(filter_)
    with open_dataset(sample_path("door")) as data, pytest.raises(BadInput, match=message):
        sensor_record([replace(data[9], task=task)])
