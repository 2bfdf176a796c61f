"""Diagnosis of shipped filters."""

from __future__ import annotations

from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.diagnosis.diagnose import diagnose


def test_clean_episodes_are_healthy() -> None:
    with open_dataset(sample_path("door")) as data:
        episodes = {index: data[index] for index in data.held_out()}
    result = diagnose(load_checkpoint(shipped("door", "crossmodal-ekf")), episodes)
    assert (result.state, result.masked, result.causes) == ("healthy", False, ())
