"""The shipped filters on the sample set: recorded with their maps, and read back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from rerun.chunk import RrdReader

from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.likelihood import MapEngine
from beliefscope.inspect.trace import Trace, trace
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.schema import STEP
from beliefscope.recordings.write import write_recording


@pytest.mark.parametrize("name", ["crossmodal-ekf", "crossmodal-pf"])
def test_a_shipped_filter_on_the_sample_set(
    name: str, assert_same: Callable[[Trace, Trace], None], tmp_path: Path
) -> None:
    checkpoint = load_checkpoint(shipped("door", name))
    with open_dataset(sample_path("door")) as dataset:
        index = next(summary.index for summary in dataset.summaries if summary.split == "test")
        traced = trace(checkpoint, dataset[index], episode_index=index, seed=3)
    steps = list(range(0, len(traced), 20))
    maps = MapEngine(checkpoint, traced).maps(steps, size=41)
    path = write_recording(traced, tmp_path / "run.rrd", maps)
    assert_same(traced, read_recording(path))
    drawn = [
        step
        for chunk in RrdReader(path).stream().filter(content="/maps/fused")
        if STEP in (batch := chunk.to_record_batch()).schema.names
        for step in batch.column(STEP).to_pylist()
    ]
    assert sorted(drawn) == steps
