"""Healthy records and the episodes that are compared with them."""

from __future__ import annotations

from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.inspect.healthy import overlap_warning


def test_diagnosed_episodes_in_the_healthy_record_are_counted() -> None:
    with open_dataset(sample_path("door")) as data:
        episodes = [data[index] for index in range(4)]
    diagnosed = episodes[2:]
    assert overlap_warning(episodes[:2], diagnosed) is None
    assert "contains 1 of the 2 diagnosed episodes" in str(overlap_warning(episodes[:3], diagnosed))
