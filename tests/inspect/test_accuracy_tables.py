"""The note on errors that are no smaller than those of the start."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from beliefscope.filters.evaluate import evaluate
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.accuracy_tables import accuracy_tables
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.trace import trace

sys.path.insert(0, str(Path(__file__).parents[1] / "filters" / "external"))
import vehicle_filters as vehicle


class Keep:
    """Keeps its start as the estimate."""

    def initialize_beliefs(self, *, mean: Any, covariance: Any) -> None:
        self.mean = np.array(mean)

    def forward(self, *, observations: Any, controls: Any) -> Any:
        return self.mean


class Gps(Keep):
    """Takes the position from the readings."""

    def forward(self, *, observations: Any, controls: Any) -> Any:
        return np.concatenate([observations["gps"], self.mean[2:]])


def external(filter_: Any) -> ExternalFilter:
    return ExternalFilter(Adapter(filter_, batched=False, initial_std=(1.0, 1.0, 1.0, 1.0)), vehicle.TASK, "mine")


def test_a_filter_that_keeps_its_start_is_no_better_than_stay() -> None:
    episodes = [vehicle.drive(seed, 60) for seed in range(2)]
    notes = []
    for filter_ in (Keep(), Gps()):
        metrics = evaluate(external(filter_), episodes, baselines=True)
        table = accuracy_tables("", metrics.to_dict())[0]
        notes.append(table.note)
        assert table.columns == ("measure", "filter", "stay")  # external filters have no dynamics baseline
        assert {len(row) for row in table.rows} == {3}
    assert notes[0].startswith(f"No better than stay: rmse {', '.join(metrics.rmse)}. ")
    assert notes[1].startswith("No better than stay: rmse vx_m/s, vy_m/s. ")
    verdicts = [DIAGNOSTICS["errors"]([trace(external(f), episodes[0])]).verdict for f in (Keep(), Gps())]
    assert "The start, which is the true state, as the estimate of all steps would have " in verdicts[0]
    assert " cm: the filter is no better." in verdicts[0]
    assert "no better" not in verdicts[1]
