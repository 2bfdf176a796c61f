"""An external filter that reports its fused belief only, of a task with several modalities: figures and reports."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import beliefscope as bs
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.figures.paper import maps_figure
from beliefscope.inspect.maps.map_engine import MapEngine
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.report.sections import event_table

TASK = bs.Task(
    name="boat",
    components=(bs.Component("x", "m"), bs.Component("y", "m")),
    observations={"gps": (2,), "sonar": (2,)},
    modalities={"gps": ("gps",), "sonar": ("sonar",)},
    control_size=0,
    dt=0.1,
    warmup=0,
    map_half_width=1.0,
    covariates={},
)


def mean_of_sensors(*, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
    mean = (observations["gps"] + observations["sonar"]) / 2
    return {"estimate_mean": mean, "estimate_covariance": np.broadcast_to(0.02 * np.eye(2), (*mean.shape, 2))}


@pytest.fixture(scope="module")
def run() -> tuple[Checkpoint, Trace]:
    rng = np.random.default_rng(0)
    states = rng.normal(0, 0.3, (12, 2)).astype(np.float32)
    readings = {key: states + rng.normal(0, 0.2, (12, 2)) for key in TASK.observations}
    filter_ = bs.load_filter(bs.Adapter(mean_of_sensors, modalities=("gps", "sonar")), TASK)
    return filter_, bs.trace(filter_, bs.open_dataset([bs.Episode(TASK, states, observations=readings)]), 0)


def test_the_figure_has_the_fused_map(run: tuple[Checkpoint, Trace]) -> None:
    figure = maps_figure(*run, {False: 3}, size=11)
    assert [axes.get_title() for axes in figure.axes if axes.images] == ["fused posterior\nstep 3"]


def test_the_event_table_has_the_fused_row(run: tuple[Checkpoint, Trace]) -> None:
    table = event_table(run[1], 3, MapEngine(*run).map(3, size=41, quantity="posterior"))
    ((*_, area, shape),) = table.rows
    assert table.rows[0][0] == "fused"
    assert shape == "round"
    assert area == pytest.approx(200 * 5.99 * np.pi, rel=0.2), "cm²"
