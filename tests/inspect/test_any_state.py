"""States of any number of components in any unit: every diagnostic, metrics, recording and report."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from beliefscope.app.protocol.trace_format import columns, header
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Component, Task
from beliefscope.datasets.task_json import task_from_json, task_to_json
from beliefscope.filters.evaluate import metrics
from beliefscope.inspect.catalog import DIAGNOSTICS, run_diagnostics
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.live_file import load_live
from beliefscope.recordings.live import LiveRecorder
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.report.compose import compose, write_report
from beliefscope.recordings.write import write_recording

COMPONENTS = (
    Component("x", "m"),
    Component("y", "m"),
    Component("heading", "rad"),
    Component("speed", "m/s", display=("km/h", 3.6)),
    Component("temperature", "K"),
    Component("drag", ""),
    *(Component(f"latent_{i}", "") for i in range(3)),
)
TASK = Task(
    name="vehicle",
    components=COMPONENTS,
    observations={"gps": (2,), "wheel": (1,)},
    modalities={"satellite": ("gps",), "odometer": ("wheel",)},
    control_size=1,
    dt=0.1,
    map_components=("x", "y"),
    map_half_width=0.4,
    warmup=0,
    covariates={},
)
N = len(COMPONENTS)


def record(folder: Path, seed: int) -> Trace:
    """Errors whose covariance is the stated one."""
    rng = np.random.default_rng(seed)
    root = np.tril(rng.normal(size=(N, N))) * 0.01 + 0.02 * np.eye(N)
    with LiveRecorder("run", task=TASK, folder=folder, views=False) as live:
        for _ in range(40):
            values = {"estimate_mean": root @ rng.normal(size=N), "estimate_covariance": root @ root.T}
            live.step(values, {"gps": np.zeros(2), "wheel": np.zeros(1)}, truth=np.zeros(N))
    return load_live(live.path)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Trace]:
    folder = tmp_path_factory.mktemp("live")
    return [record(folder, seed) for seed in range(6)]


def test_metrics_are_in_the_display_units() -> None:
    error = torch.zeros(5, N)
    error[:, 3], error[:, 4], error[:, 2] = 2.0, 0.5, np.pi / 2
    rmse = metrics(TASK, error, torch.full((5, N, N), torch.nan)).rmse
    assert rmse["speed_km/h"] == pytest.approx(7.2)
    assert rmse["temperature_K"] == pytest.approx(0.5)
    assert rmse["heading_deg"] == pytest.approx(90.0)
    assert rmse["drag"] == 0.0
    assert len(rmse) == N + 1


def test_nees_over_n_is_one(runs: list[Trace]) -> None:
    nees = np.concatenate([measures.nees(run)[:, -1] for run in runs])
    assert nees.mean() == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / N / len(nees)))


def test_every_diagnostic_is_computed_or_refused_with_a_reason(runs: list[Trace]) -> None:
    results, reasons = run_diagnostics(runs, None, {name: {} for name in DIAGNOSTICS}, True)
    assert "consistency" in results
    assert all(result.verdict and result.tables() for result in results.values())
    assert all(reasons.values())


@pytest.mark.slow
@pytest.mark.long
def test_recording_report_and_page(runs: list[Trace], tmp_path: Path) -> None:
    run = read_recording(write_recording(runs[0], tmp_path / "run.rrd"))
    assert run.task == TASK
    write_report(compose([run], None, files=[tmp_path / "run.rrd"]), tmp_path / "report")
    assert "speed (km/h)" in (tmp_path / "report" / "report.html").read_text()
    components = header(run, columns(run)[0], TASK, None, {})["components"]
    assert components[3] == {"name": "speed", "unit": "m/s", "display_unit": "km/h", "scale": 3.6}
    assert components[5] == {"name": "drag", "unit": "", "display_unit": "", "scale": 1.0}


@pytest.mark.parametrize(
    ("component", "message"),
    [
        (Component("x", "m", display=("km", 0.0)), "has display .*'km', 0.0.*, expected a unit and a factor above 0"),
        (Component("x", "rad", display=("turns", 0.2)), "has display"),
    ],
)
def test_inconsistent_units_are_rejected(component: Component, message: str) -> None:
    values = task_to_json(TASK)
    changed = task_to_json(Task("a", (component, COMPONENTS[1]), {}, {}, 1, 0.1, ("x", "y"), 0.1))["components"]
    with pytest.raises(BadInput, match=message):
        task_from_json(values | {"components": changed})
