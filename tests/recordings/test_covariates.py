"""Covariates of a custom task: recorded, stored in every format, and used as groups. Nothing undeclared is assumed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from beliefscope.app.protocol.trace_format import columns, header
from beliefscope.datasets.covariate import Covariate
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, write_dataset
from beliefscope.datasets.task import Component, Task
from beliefscope.datasets.task_json import task_from_json, task_to_json
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnostics.consistency import Consistency
from beliefscope.inspect.slices.covariates import covariates_of
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace, load_trace, save_trace
from beliefscope.inspect.traces.live_file import load_live
from beliefscope.recordings.live import LiveRecorder
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.write import write_recording

TASK = Task(
    name="rover",
    components=(Component("x", "m"), Component("y", "m")),
    observations={"gps": (2,)},
    modalities={"satellite": ("gps",)},
    control_size=1,
    dt=0.1,
    map_components=("x", "y"),
    map_half_width=0.4,
    warmup=0,
    covariates={
        "fix": Covariate("boolean"),
        "stage": Covariate("categorical", ("slide", "lift")),
        "speed": Covariate("continuous", cuts=(0.5, 0.75), unit="m/s"),
        "height": Covariate("continuous", unit="m"),
    },
)
STEPS, FIX = 80, 40  # the fix is lost at step 40 and unknown from step 60


def record(folder: Path, seed: int) -> Trace:
    """Errors of one standard deviation with a fix, and of ten without."""
    rng = np.random.default_rng(seed)
    with LiveRecorder("run", task=TASK, folder=folder, views=False) as live:
        for t in range(STEPS):
            error = rng.normal(0, 0.01 if t < FIX else 0.1, 2)
            live.step(
                {"estimate_mean": error, "estimate_covariance": 1e-4 * np.eye(2)},
                {"gps": error},
                truth=np.zeros(2),
                covariates={
                    "fix": None if t >= 60 else t < FIX,
                    "stage": ("slide", "lift")[t % 2],
                    "speed": t % 20 / 20,
                },
            )
    return load_live(live.path)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Trace:
    return record(tmp_path_factory.mktemp("live"), 0)


def test_groups_have_exact_masks(run: Trace) -> None:
    counts = {phase: int(mask.sum()) for phase, mask in measures.phases(run).items()}
    assert counts == {
        "all": 80,
        "fix": 40,
        "no fix": 20,
        "slide": 40,
        "lift": 40,
        "speed below 0.5 m/s": 40,
        "speed 0.5 to 0.75 m/s": 20,
        "speed from 0.75 m/s": 20,
        "blackout": 0,
    }
    assert np.isnan(run.episode.covariate("height")).all()


def test_audits_use_the_groups(tmp_path: Path) -> None:
    result = DIAGNOSTICS["consistency"]([record(tmp_path, seed) for seed in range(6)])
    assert isinstance(result, Consistency)
    assert "Least consistent phase: no fix, overconfident" in result.verdict
    assert set(result.phases) >= {"fix", "no fix", "slide", "lift", "speed below 0.5 m/s"}
    assert "contact" not in " ".join(result.phases)


def test_slices_are_searched_over_the_covariates(run: Trace) -> None:
    covariates = {covariate.name: covariate for covariate in covariates_of([run])}
    assert covariates["stage"].categories == ("lift", "slide")
    assert covariates["fix"].categories == ("fix", "no fix")
    assert int(np.isnan(covariates["fix"].values).sum()) == 20
    assert (covariates["speed"].unit, covariates["speed"].values.max()) == ("m/s", pytest.approx(0.95))
    assert "contact" not in covariates


@pytest.mark.parametrize(("half_width", "unit", "factor"), [(0.4, "cm", 100.0), (10.0, "m", 1.0)])
def test_slices_have_the_units_of_the_page(run: Trace, half_width: float, unit: str, factor: float) -> None:
    task = replace(TASK, map_half_width=half_width)
    states = np.arange(2 * STEPS).reshape(STEPS, 2).astype(np.float32)
    covariates = covariates_of([replace(run, episode=replace(run.episode, task=task, states=states))])
    (x,) = (covariate for covariate in covariates if covariate.name == "true x")
    (speed,) = (covariate for covariate in covariates if covariate.name == "object speed")
    assert (x.unit, speed.unit) == (unit, f"{unit}/s")
    np.testing.assert_allclose(x.values, factor * states[:, 0])
    assert speed.values.max() == pytest.approx(factor * np.hypot(2.0, 2.0) / TASK.dt)


def by_trace(run: Trace, folder: Path) -> Trace:
    save_trace(run, folder / "run.trace")
    return load_trace(folder / "run.trace")


def by_recording(run: Trace, folder: Path) -> Trace:
    return read_recording(write_recording(run, folder / "run.rrd"))


def by_dataset(run: Trace, folder: Path) -> Trace:
    write_dataset(folder / "data.h5", run.task, [run.episode])
    with open_dataset(folder / "data.h5") as data:
        return replace(run, episode=data[0])


@pytest.mark.parametrize("copy", [by_trace, by_recording, by_dataset])
def test_every_format_keeps_the_values(run: Trace, tmp_path: Path, copy: Callable[[Trace, Path], Trace]) -> None:
    result = copy(run, tmp_path)
    assert result.task == run.task == TASK
    assert result.episode.covariates.keys() == run.episode.covariates.keys()
    for name, values in run.episode.covariates.items():
        np.testing.assert_array_equal(result.episode.covariates[name], values)
    assert result.episode.digest() == run.episode.digest()


def test_the_page_receives_the_groups(run: Trace) -> None:
    descriptions, buffer = columns(run)
    names = header(run, descriptions, TASK, None, {})["groups"]
    assert names == ["fix", "slide", "lift", *(p for p in measures.phases(run) if p.startswith("speed"))]
    column = next(c for c in descriptions if c["name"] == "groups")
    values = np.frombuffer(buffer, "<f4", STEPS * len(names), column["offset"]).reshape(STEPS, len(names))
    np.testing.assert_array_equal(values[:, 0], np.arange(STEPS) < FIX)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"contact": True}, "covariate 'contact' of task 'rover' does not exist. Available: fix, stage, speed, height"),
        ({"stage": "push"}, "group 'push' of covariate 'stage' does not exist. Available: slide, lift"),
    ],
)
def test_undeclared_covariates_are_rejected(tmp_path: Path, values: dict[str, bool | str], message: str) -> None:
    with pytest.raises(BadInput, match=message), LiveRecorder("run", task=TASK, folder=tmp_path, views=False) as live:
        live.step(np.zeros(2), {"gps": np.zeros(2)}, covariates=values)


@pytest.mark.parametrize(
    ("covariates", "message"),
    [
        ({"a": Covariate("boolean", ("no", "yes")), "b": Covariate("boolean", ("no", "b"))}, "have the same name"),
        ({"a": Covariate("continuous", cuts=(2.0, 1.0))}, r"has cuts \[?\(?2.0, 1.0"),
        ({"a": Covariate("categorical")}, "has groups \\(\\), expected one or more names"),
        ({"a": Covariate("continuous", ("low",), (1.0,))}, "has groups \\('low',\\), expected 2 names"),
        ({"a": Covariate("often")}, "has kind 'often', expected one of boolean, categorical, continuous"),  # type: ignore[arg-type]
    ],
)
def test_inconsistent_covariates_are_rejected(covariates: dict[str, Covariate], message: str) -> None:
    with pytest.raises(BadInput, match=message):
        task_from_json(task_to_json(replace(TASK, covariates=covariates)))
