"""Irregular time steps: every file keeps them, and a filter receives their durations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from rerun.chunk import RrdReader

from beliefscope.app.protocol.trace_format import columns
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, write_dataset
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import as_external
from beliefscope.inspect.catalog import run_diagnostics
from beliefscope.inspect.compare.counterfactual import compare
from beliefscope.inspect.compare.two_runs import compare_runs
from beliefscope.inspect.diagnosis.checks.sensors import sensor_statistics
from beliefscope.inspect.slices.covariates import _step_columns
from beliefscope.inspect.trace import Trace, load_trace, save_trace, trace
from beliefscope.inspect.traces.live_file import LiveFileReader
from beliefscope.inspect.traces.replay import Intervention
from beliefscope.recordings.export import as_parquet
from beliefscope.recordings.live import LiveRecorder
from beliefscope.recordings.live_episode import record_steps
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.report.figures import error_figure
from beliefscope.recordings.report.sections import event_table
from beliefscope.recordings.write import write_recording

TASK = Task(
    name="cart",
    components=(Component("x", "m"),),
    observations={"range": (1,), "camera": (8, 8)},
    modalities={"range": ("range",), "camera": ("camera",)},
    control_size=1,
    dt=0.1,
    periods={"camera": 0.5},
    warmup=0,
)


class DeadReckoning:
    """Adds speed times duration; it is exact if the durations are right."""

    def initialize_beliefs(self) -> np.ndarray:
        self.x = np.zeros((1, 1))
        return self.x

    def forward(self, observations: dict[str, Any], controls: np.ndarray) -> np.ndarray:
        self.x = self.x + controls * observations.get("dt", TASK.dt)[:, None]
        return self.x


@pytest.fixture(scope="module")
def episode() -> Episode:
    """60 steps of 0.05 to 0.2 s at varying speed, with a camera image every five steps."""
    rng = np.random.default_rng(0)
    time = np.concatenate([[0.0], np.cumsum(rng.uniform(0.05, 0.2, 59))])
    speed = rng.uniform(0.5, 1.0, (60, 1))
    x = np.cumsum(speed * np.concatenate([[0.1], np.diff(time)])[:, None], axis=0)
    camera = np.repeat(rng.integers(0, 255, (12, 8, 8)), 5, axis=0).astype(np.uint8)
    return Episode(TASK, x, speed, {"range": x + rng.normal(0, 0.01, (60, 1)), "camera": camera}, time=time)


@pytest.fixture(scope="module")
def run(episode: Episode) -> Trace:
    return trace(as_external(Adapter(DeadReckoning(), task=TASK), "dead-reckoning"), episode)


def test_a_filter_receives_the_durations(run: Trace, episode: Episode) -> None:
    np.testing.assert_allclose(run.estimate_mean, episode.states, atol=1e-5)
    regular = replace(episode, time=None)
    assert regular.digest() != episode.digest()
    np.testing.assert_allclose(regular.times[:3], [0.0, 0.1, 0.2])


def test_every_file_keeps_the_times(
    run: Trace, episode: Episode, assert_same: Callable[..., None], tmp_path: Path
) -> None:
    write_dataset(tmp_path / "cart.h5", TASK, [episode])
    with open_dataset(tmp_path / "cart.h5") as data:
        assert np.array_equal(data[0].times, episode.times)
    save_trace(run, tmp_path / "run.trace")
    assert_same(load_trace(tmp_path / "run.trace"), run)
    recording = write_recording(run, tmp_path / "run.rrd")
    assert_same(read_recording(recording), run)
    table = pq.read_table(BytesIO(as_parquet(run)))
    np.testing.assert_array_equal(table["time"].to_numpy(), episode.time)
    (column,) = [c for c in columns(run)[0] if c["name"] == "time"]
    assert column["shape"] == [60]
    for chunk in RrdReader(recording).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == "/states/x/fused" and "time" in batch.schema.names:
            steps = batch.column("step").to_numpy()
            seconds = batch.column("time").to_numpy().astype(np.int64) / 1e9
            np.testing.assert_allclose(seconds, episode.times[steps], atol=1e-9)


def test_a_live_run_keeps_the_times(run: Trace, episode: Episode, tmp_path: Path) -> None:
    checkpoint = as_external(Adapter(DeadReckoning(), task=TASK), "dead-reckoning")
    recorder, steps = record_steps(checkpoint, episode, 0, 0, 1, Faults(()), "run", tmp_path)
    with recorder:
        list(steps)
    reader = LiveFileReader(recorder.path)
    reader.poll()
    live = reader.part()
    np.testing.assert_array_equal(live.episode.times, episode.times)
    np.testing.assert_array_equal(read_recording(recorder.path.with_suffix(".rrd")).episode.times, episode.times)
    np.testing.assert_array_equal(live.estimate_mean, run.estimate_mean)


def test_a_slow_sensor_may_be_missing(episode: Episode, tmp_path: Path) -> None:
    with LiveRecorder("slow", task=TASK, folder=tmp_path, views=False) as live:
        for t in range(10):
            keys = ["range", "camera"] if t % 5 == 0 else ["range"]
            live.step(np.zeros(1), {key: episode.observations[key][t] for key in keys}, time=100.0 + episode.times[t])
    reader = LiveFileReader(live.path)
    reader.poll()
    assert np.array_equal(reader.part().episode.observations["camera"], episode.observations["camera"][:10])
    np.testing.assert_allclose(reader.part().episode.times, episode.times[:10], atol=1e-9)


@pytest.mark.parametrize(("second", "message"), [(None, "a step has no time"), (0.5, r"0\.5 s at step 1, after 1 s")])
def test_a_live_run_refuses_wrong_times(second: float | None, message: str, tmp_path: Path) -> None:
    def record() -> None:
        live = LiveRecorder("bad", task=TASK, folder=tmp_path, views=False)
        for time in (1.0, second):
            live.step(np.zeros(1), {"range": [0.0]}, time=time)
        live.close()

    with pytest.warns(UserWarning, match=message):
        record()


def test_times_that_do_not_ascend_are_refused(run: Trace, episode: Episode, tmp_path: Path) -> None:
    time = episode.times.copy()
    time[7] = time[6]
    write_dataset(tmp_path / "cart.h5", TASK, [replace(episode, time=time)])
    with (
        open_dataset(tmp_path / "cart.h5") as data,
        pytest.raises(BadInput, match=r"at step 7.*ascend"),
    ):
        data[0]
    save_trace(replace(run, episode=replace(episode, time=time)), tmp_path / "run.trace")
    with pytest.raises(BadInput, match="at step 7"):
        load_trace(tmp_path / "run.trace")


def test_a_slow_sensor_is_not_frozen(episode: Episode) -> None:
    """Its images repeat four times; a freeze of thirty steps is reported."""
    assert sensor_statistics(episode, None)["frozen/camera/all"] == 0.0
    fast = replace(episode, task=replace(TASK, periods={}))
    assert sensor_statistics(fast, None)["frozen/camera/all"] > 0.7
    frozen = episode.observations["camera"].copy()
    frozen[20:50] = frozen[20]
    faulty = replace(episode, observations={**episode.observations, "camera": frozen})
    assert sensor_statistics(faulty, None)["frozen/camera/all"] == pytest.approx(29 / 60)


def test_covariates_are_in_seconds(run: Trace, episode: Episode) -> None:
    values = {name: v for name, _, v in _step_columns(run, TASK)}
    np.testing.assert_array_equal(values["time since start"], episode.times)


def test_figures_are_drawn_over_the_times(run: Trace, episode: Episode) -> None:
    errors = run_diagnostics([run], None)[0]["errors"]
    for figure in (errors.plot(episode.time), error_figure([run], {0: [(7, "1")]})):
        chart = figure.axes[0]
        assert chart.get_xlabel() == "time (s)"
        np.testing.assert_array_equal(chart.lines[0].get_xdata(), episode.time)
        assert chart.get_xlim()[0] < 0.0 < episode.times[-1] < chart.get_xlim()[1] < episode.times[-1] + 0.1
    assert chart.lines[-1].get_xdata()[0] == episode.times[7]
    (text,) = chart.texts
    assert text.xy[0] == episode.times[7]
    regular = replace(run, episode=replace(episode, time=None))
    mixed = error_figure([run, regular], {})
    assert [axes.get_xlabel() for axes in mixed.axes] == ["time (s)", "step"]
    plain = error_figure([regular], {})
    assert plain.axes[0].get_xlabel() == "step"
    np.testing.assert_array_equal(plain.axes[0].lines[0].get_xdata(), np.arange(60))
    assert errors.plot().axes[0].get_xlabel() == "step"


def test_tables_name_the_times(run: Trace, episode: Episode) -> None:
    counterfactual = replace(run, estimate_mean=run.estimate_mean + np.where(np.arange(60) == 9, 0.5, 0.0)[:, None])
    counterfactual = replace(counterfactual, estimate_mean=counterfactual.estimate_mean.astype(np.float32))
    result = compare(run, counterfactual, Intervention(5, 9, Faults.parse("sensor_bias=range:offset=1")))
    assert f"(step 9, {episode.times[9]:.2f} s)" in result.verdict
    table = next(table for table in result.tables() if table.title == "Largest difference of the estimates")
    assert (table.columns[-1], table.rows[0][-2:]) == ("time (s)", (9, episode.times[9]))
    assert f"(step 9, {episode.times[9]:.2f} s)" in compare_runs(run, counterfactual).verdict
    assert event_table(run, 9, None).title == f"Step 9 ({episode.times[9]:.2f} s) of episode 0"
    plain = replace(run, episode=replace(episode, time=None))
    assert event_table(plain, 9, None).title == "Step 9 of episode 0"
