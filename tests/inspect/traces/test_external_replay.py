"""Counterfactuals, standalone runs, Shapley values and diagnosis of external filters."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.evaluate import STANDALONE, evaluate
from beliefscope.filters.external.ablation import without
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import ExternalFilter, load_external
from beliefscope.inspect.accuracy_tables import accuracy_tables
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.compare.counterfactual import compare
from beliefscope.inspect.diagnosis.checks.modules import model_statistics
from beliefscope.inspect.diagnosis.undo.run_inputs import RunInputs
from beliefscope.inspect.diagnosis.undo.undo import drop
from beliefscope.inspect.standalone import standalone
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import ARRAYS, trace
from beliefscope.inspect.traces.external_replay import open_replay
from beliefscope.inspect.traces.replay import Intervention

sys.path.insert(0, str(Path(__file__).parents[2] / "filters" / "external"))
import vehicle_filters as vehicle

EXAMPLE = str(Path(__file__).parents[3] / "examples" / "04_own_filter.py:build")


def external(filter_: Any, **adapter: Any) -> ExternalFilter:
    return ExternalFilter(Adapter(filter_, batched=False, **{"absent": "nan", **adapter}), vehicle.TASK, "mine")


@pytest.fixture(scope="module")
def door() -> list[Episode]:
    with open_dataset(sample_path("door")) as data:
        return [data[index] for index in data.held_out()[:2]]


def test_counterfactual_changes_only_later_steps_and_its_own_sensors(door: list[Episode]) -> None:
    filter_ = load_external(EXAMPLE)
    replay = open_replay(filter_, trace(filter_, door[0], 3))
    assert replay.exact
    counterfactual = replay.with_intervention(Intervention(20, 40, Faults.parse("effector_offset=5")))
    before, after = replay.original.estimate_mean, counterfactual.estimate_mean
    np.testing.assert_array_equal(before[:20], after[:20])
    assert np.abs(before[20:] - after[20:]).max() > 1e-3
    verdict = compare(replay.original, counterfactual, Intervention(20, 40, Faults.parse("effector_offset=5"))).verdict
    assert "the estimate moved by up to" in verdict
    blind = replay.with_intervention(Intervention(20, 40, Faults.parse("blackout")))  # the filter uses no image
    np.testing.assert_array_equal(before, blind.estimate_mean)
    assert open_replay(filter_, counterfactual).exact  # of a run with an intervention
    with pytest.raises(BadInput, match="fusion weights cannot be set"):
        replay.with_intervention(Intervention(20, 40, weights={"image": 0.5}))
    with pytest.raises(BadInput, match="step 101 is after the last step"):
        replay.with_intervention(Intervention(20, 101, Faults.parse("blackout")))


class Noisy(vehicle.NumpyKalman):
    """A filter with a random generator of its own, which no initialisation resets."""

    def __init__(self) -> None:
        super().__init__()
        self.generator = np.random.default_rng(0)

    def forward(self, **inputs: Any) -> dict[str, Any]:
        values = super().forward(**inputs)
        return values | {"estimate_mean": values["estimate_mean"] + 0.01 * self.generator.standard_normal(4)}


def test_filters_with_their_own_generator_keep_their_random_numbers() -> None:
    filter_ = external(Noisy())
    run = trace(filter_, vehicle.drive(1))
    replay = open_replay(filter_, run)
    assert not replay.exact  # the generator went on
    counterfactual = replay.with_intervention(Intervention(0, 1))  # without effect
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(replay.original, name), getattr(counterfactual, name))


def test_standalone_runs_see_one_sensor() -> None:
    filter_, episode = external(vehicle.NumpyKalman()), vehicle.drive(2)
    alone = standalone(filter_, trace(filter_, episode), "gps")
    silent = without(episode, ["speed"], "nan")
    assert np.isnan(silent.observations["speed"]).all()
    np.testing.assert_array_equal(alone.estimate_mean, trace(filter_, silent).estimate_mean)
    assert alone.modalities == ()
    assert alone.innovation is None
    result = evaluate(filter_, [episode], only="gps", modalities=True)
    assert result.rmse == result.standalone["gps"].rmse
    assert result.rmse["y_cm"] < result.standalone["speed"].rmse["y_cm"]  # the speed sensor measures vx only
    with pytest.raises(BadInput, match="modality 'lidar' of task 'vehicle' does not exist"):
        evaluate(filter_, [episode], only="lidar")


class NeedsGps(vehicle.NumpyKalman):
    def forward(self, **inputs: Any) -> dict[str, Any]:
        if np.isnan(inputs["observations"]["gps"]).any():
            raise ValueError("no position")
        return super().forward(**inputs)


def test_metrics_of_a_filter_that_fails_without_a_sensor() -> None:
    result = evaluate(external(NeedsGps()), [vehicle.drive(2), vehicle.drive(3, 50)], modalities=True)
    expected = evaluate(external(vehicle.NumpyKalman()), [vehicle.drive(2), vehicle.drive(3, 50)], modalities=True)
    assert result.standalone["speed"] is None
    assert (result.rmse, result.standalone["gps"].rmse) == (expected.rmse, expected.standalone["gps"].rmse)
    _, table = accuracy_tables("", {**result.to_dict(), "baselines": {}})
    assert table.note == "The filter fails with speed only."
    column = table.columns.index(STANDALONE.format("speed"))
    assert [row[column] for row in table.rows] == [None] * len(result.rmse)
    with pytest.raises(BadInput, match="fails at step 0: ValueError: no position"):
        evaluate(external(NeedsGps()), [vehicle.drive(2)], only="speed")


def test_absent_sensors_have_their_mean() -> None:
    episode = vehicle.drive(2, gap=(10, 20))
    readings = without(episode, ["gps"], "mean", slice(0, 50)).observations["gps"]
    np.testing.assert_allclose(readings[:50], np.tile(np.nanmean(episode.observations["gps"], 0), (50, 1)), rtol=1e-5)
    np.testing.assert_array_equal(readings[50:], episode.observations["gps"][50:])


def test_runs_with_the_mean_of_a_removed_sensor_say_so() -> None:
    for absent, expected in (("nan", False), ("mean", True)):
        filter_ = external(vehicle.NumpyKalman(), absent=absent)
        run = trace(filter_, vehicle.drive(2))
        for name in ("standalone", "efficiency", "shapley"):
            verdict = DIAGNOSTICS[name]([run], filter_).verdict
            assert ('Adapter(absent="nan")' in verdict) == expected, name


@pytest.mark.slow
def test_shapley_values_add_up() -> None:
    filter_ = external(vehicle.NumpyKalman())
    runs = [trace(filter_, vehicle.drive(seed), seed) for seed in range(3)]
    result: Any = DIAGNOSTICS["shapley"](runs, filter_)
    total = result.phases[0]
    np.testing.assert_allclose(total.shapley.sum(0), total.rmse[-1] - total.rmse[0], atol=1e-12)
    assert total.shapley[0, 0] < 0.0  # GPS lowers the position error
    for name in ("standalone", "efficiency"):
        assert DIAGNOSTICS[name](runs, filter_).verdict


def test_errors_are_statistics_of_an_external_filter(door: list[Episode]) -> None:
    filter_ = load_external(EXAMPLE)
    run = trace(filter_, door[0])
    error = measures.main_error(run)[measures.counted(run), -1]
    expected = float(np.sqrt(np.square(error).mean()))
    assert model_statistics(run, filter_)["error//all"] == pytest.approx(expected)


def test_dropping_a_sensor_is_an_undo(door: list[Episode]) -> None:
    filter_ = load_external(EXAMPLE)
    inputs = RunInputs(filter_, dict(enumerate(door[:2])), 300, frozenset({1}), (10, 20))
    changed = drop("haptics", inputs, {})
    assert changed is not None
    same, other = (changed.episodes[i].observations["force"] == door[i].observations["force"] for i in (0, 1))
    assert same.all()
    assert other[:10].all()
    assert not other[10:20].all()
    assert drop("sound", inputs, {}) is None
    assert replace(inputs, affected=frozenset()).episodes == inputs.episodes


def test_occlusion_of_a_step_equals_the_kalman_gain() -> None:
    pytest.importorskip("captum", reason="captum is not installed (pip install .[attribution])")
    filter_, episode = external(vehicle.NumpyKalman()), vehicle.drive(2)
    run = trace(filter_, episode)
    for step in (0, 57):
        result: Any = DIAGNOSTICS["saliency"]([run], filter_, step=step, target="x")
        assert result.value == pytest.approx(run.estimate_mean[step, 0], abs=1e-5)
        # The estimate is linear in the reading: its change is the gain times the change of the reading.
        changed = {key: value.copy() for key, value in episode.observations.items()}
        changed["gps"][step, 0] = episode.observations["gps"][:, 0].mean()
        other = trace(filter_, replace(episode, observations=changed)).estimate_mean[step, 0]
        assert result.occlusion["gps"][0] == pytest.approx(run.estimate_mean[step, 0] - other, abs=1e-5)
        assert "Largest change by one channel or square" in result.verdict
        assert result.views()["tables"]
    with pytest.raises(BadInput, match="target 'z' of filter 'mine' does not exist"):
        DIAGNOSTICS["saliency"]([run], filter_, target="z")
