"""Filters of filterpy through the adapter, compared with the same equations written out."""

from __future__ import annotations

import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.filterpy_filters import FilterPy
from beliefscope.filters.external.load import ExternalFilter, load_external
from beliefscope.inspect.catalog import quick
from beliefscope.inspect.trace import Trace, trace
from beliefscope.inspect.traces.external_replay import open_replay
from beliefscope.inspect.traces.replay import Intervention

sys.path.insert(0, str(Path(__file__).parent))
import vehicle_filters as vehicle

pytestmark = pytest.mark.skipif(find_spec("filterpy") is None, reason="filterpy is not installed (pip install .[test])")

SOURCE = str(vehicle.GALLERY / "filterpy_vehicle.py")


def run(name: str, seed: int = 1, **options: Any) -> Trace:
    return trace(load_external(f"{SOURCE}:{name}", vehicle.TASK), vehicle.drive(seed, **options))


def test_kalman_filter_equals_its_equations() -> None:
    actual = run("kalman", gap=(40, 60))
    own = ExternalFilter(Adapter(vehicle.NumpyKalman(), batched=False), vehicle.TASK, "own")
    expected = trace(own, vehicle.drive(1, gap=(40, 60)))
    names = ("estimate_mean", "estimate_covariance", "innovation", "innovation_covariance", "start_covariance")
    for name in names:
        np.testing.assert_allclose(getattr(actual, name), getattr(expected, name), rtol=1e-4, atol=1e-6, err_msg=name)
    assert actual.accepted is None
    assert actual.modalities == ("gps", "speed")


def test_each_innovation_is_that_of_the_prediction_before_its_update() -> None:
    result, readings = run("kalman"), vehicle.drive(1).observations
    assert result.predicted_mean is not None
    assert result.innovation is not None
    for k, key in enumerate(result.modalities):
        expected = readings[key] - result.predicted_mean[:, k] @ vehicle.H[key].T
        np.testing.assert_allclose(result.innovation[:, k, : expected.shape[1]], expected, atol=1e-5)


@pytest.mark.parametrize("updates", [{"gps": lambda f, z: f.update(z)}, None])
def test_steps_without_a_reading_are_those_of_the_mask(updates: Any) -> None:
    observations = {"gps": (2,)}
    task = replace(vehicle.TASK, observations=observations, modalities={"gps": ("gps",)}, masks={"gps": "fix"})
    episode = vehicle.drive(1, gap=(40, 60))
    episode = replace(episode, task=task, observations={"gps": episode.observations["gps"]})
    inner = load_external(f"{SOURCE}:kalman", vehicle.TASK).adapter.module.filter
    inner.H, inner.R = vehicle.H["gps"], vehicle.R["gps"]
    adapter = Adapter(FilterPy(inner, updates, own_start=True), batched=False, modalities=("gps",))
    result = trace(ExternalFilter(adapter, task, "masked"), episode)
    assert result.innovation is not None
    missing = np.isnan(result.innovation[:, 0, 0])
    np.testing.assert_array_equal(missing, (np.arange(len(episode)) >= 40) & (np.arange(len(episode)) < 60))


def test_gate_rejects_outliers_and_restores_the_prediction() -> None:
    gated, free = run("gated", outliers=0.1), run("kalman", outliers=0.1)
    episode = vehicle.drive(1, outliers=0.1)
    off = np.abs(episode.observations["gps"] - episode.states[:, :2]).max(1) > 3.0
    assert off.sum() > 5
    assert gated.accepted is not None
    np.testing.assert_array_equal(gated.accepted[:, 0] == 0.0, off)
    errors = [np.abs(result.estimate_mean - episode.states)[:, :2].max() for result in (gated, free)]
    assert errors[0] < 0.5 < errors[1]


def test_start_at_the_truth_and_states_of_part_of_the_filter() -> None:
    from filterpy.kalman import KalmanFilter

    filter_ = KalmanFilter(dim_x=6, dim_z=2)  # two biases before the four components
    filter_.F = np.block([[np.eye(2), np.zeros((2, 4))], [np.zeros((4, 2)), vehicle.F]])
    filter_.H = np.block([np.zeros((2, 2)), vehicle.H["gps"]])
    filter_.Q = np.block([[np.zeros((2, 2)), np.zeros((2, 4))], [np.zeros((4, 2)), vehicle.Q]])
    filter_.R = vehicle.R["gps"]
    adapted = FilterPy(filter_, {"gps": lambda f, z: f.update(z)}, state=range(2, 6))
    external = ExternalFilter(Adapter(adapted, std=(1.0,) * 4, batched=False), vehicle.TASK, "part")
    result = trace(external, vehicle.drive(2))
    np.testing.assert_allclose(result.start_covariance, 0.1 * np.eye(4), rtol=1e-5)
    np.testing.assert_allclose(result.start_mean, vehicle.drive(2).states[0])
    assert np.abs(result.estimate_mean - vehicle.drive(2).states)[:, :2].max() < 1.0
    assert np.shape(filter_.x) == (6, 1)
    assert not filter_.x.any()  # the given filter is not changed


def test_unscented_and_ensemble_filters() -> None:
    exact = run("unscented")
    ensemble = run("ensemble")
    assert exact.modalities == ("gps",)
    assert exact.innovation is not None
    assert ensemble.particles is not None
    assert ensemble.particles.shape == (120, 50, 4)
    # The ensemble approximates the Kalman filter; its standard error is 1 / sqrt(50) standard deviations.
    deviation = np.sqrt(np.diagonal(exact.estimate_covariance, axis1=1, axis2=2))
    assert np.sqrt(np.square((ensemble.estimate_mean - exact.estimate_mean) / deviation).mean()) < 0.7
    assert {"ensemble", "errors", "consistency"} <= set(quick(ensemble))
    assert {"innovations", "errors", "consistency"} == set(quick(exact))


def test_runs_are_repeatable() -> None:
    filter_ = load_external(f"{SOURCE}:ensemble", vehicle.TASK)
    replay = open_replay(filter_, trace(filter_, vehicle.drive(3), seed=5))
    assert replay.exact
    again = replay.with_intervention(Intervention(0, 1))
    np.testing.assert_array_equal(again.estimate_mean, replay.original.estimate_mean)
