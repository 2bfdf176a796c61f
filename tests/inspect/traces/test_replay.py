"""Replays of all kinds of filters are bit-identical."""

from __future__ import annotations

import numpy as np
import pytest

from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.trace import ARRAYS, trace
from beliefscope.inspect.traces.replay import Intervention, Replay


@pytest.mark.long
@pytest.mark.parametrize(
    "name", ["crossmodal-ukf", "information-ekf", "information-pf", "unimodal-ekf", "unimodal-pf", "feature-pf", "lstm"]
)
def test_empty_edit_is_bit_identical(name: str) -> None:
    checkpoint = Checkpoint(build(architecture("door", name)).eval().requires_grad_(False), name, "0" * 64, {})
    with open_dataset(sample_path("door")) as data:
        replay = Replay(checkpoint, trace(checkpoint, data[9], 9, seed=3, particles=50))
    assert replay.exact
    again = replay.with_intervention(Intervention(40, 100))
    for array in ARRAYS:
        np.testing.assert_array_equal(getattr(again, array), getattr(replay.original, array), err_msg=array)


def test_edit_of_an_earlier_version() -> None:
    intervention = Intervention(3, 5, Faults.parse("blackout"))
    values = intervention.to_json()
    assert Intervention.from_json({**values, "recipe": values.pop("faults")}) == intervention
