"""Diagnostics of innovations and gates, ensembles and point estimates, on planted traces with known answers."""

from __future__ import annotations

import functools
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.catalog import DIAGNOSTICS, quick
from beliefscope.inspect.trace import Trace, trace

sys.path.insert(0, str(Path(__file__).parents[2] / "filters" / "external"))
import vehicle_filters as vehicle

STEPS = 300
CHI2 = {1: 10.828, 2: 13.816}  # 99.9 % quantiles


@functools.cache
def traces(count: int = 6, outliers: bool = False, **filter_: Any) -> list[Trace]:
    """Runs of a Kalman filter; ``outliers``: every tenth GPS reading is 5 m off."""
    external = ExternalFilter(Adapter(vehicle.NumpyKalman(**filter_), batched=False), vehicle.TASK, "mine")
    episodes = [vehicle.drive(seed, STEPS) for seed in range(count)]
    if outliers:
        for episode in episodes:
            episode.observations["gps"][::10] += 5.0
    return [trace(external, episode, i) for i, episode in enumerate(episodes)]


def test_innovations_of_a_matched_filter_are_consistent_and_the_gate_acts() -> None:
    result: Any = DIAGNOSTICS["innovations"](traces(outliers=True, gate=20.0))
    gps, speed = result.modalities
    assert (gps.channels, speed.channels) == (2, 1)
    assert gps.gate == "acts"
    assert gps.accepted == pytest.approx(0.9, abs=0.01)
    assert speed.gate == "never needed"
    assert speed.consistent
    assert gps.missed < 5


def test_a_sensor_without_any_measurement_is_named() -> None:
    (run,) = traces(1)
    assert run.innovation is not None
    innovation = run.innovation.copy()
    innovation[:, 1] = np.nan
    result: Any = DIAGNOSTICS["innovations"]([replace(run, innovation=innovation)])
    assert "speed: no measurement." in result.verdict
    assert "nan" not in result.verdict


@pytest.mark.slow
def test_gates_that_never_act_or_always_reject_are_reported() -> None:
    never: Any = DIAGNOSTICS["innovations"](traces(outliers=True))
    assert never.modalities[0].gate == "never acts"
    assert never.modalities[0].missed > 100
    assert any("the gate of gps never acts" in alarm for alarm in never.alarms)
    assert "although" in never.verdict
    always: Any = DIAGNOSTICS["innovations"](traces(gate=0.0))
    assert [entry.gate for entry in always.modalities] == ["always rejects"] * 2
    assert all(entry.longest == STEPS for entry in always.modalities)


def test_wrong_measurement_noise_is_inconsistent() -> None:
    result: Any = DIAGNOSTICS["innovations"](traces(scale=9.0))
    assert all(entry.high < 1.0 for entry in result.modalities)
    assert "innovations of gps are inconsistent" in result.alarms


def sampled(ratio: float, members: int = 30, seed: int = 0) -> list[Trace]:
    """Ensembles whose members and true state have the same distribution, except for a factor on the spread."""
    rng = np.random.default_rng(seed)
    result = []
    for run in traces(4):
        scale = 0.1 * np.exp(0.5 * rng.standard_normal((len(run), 1)))
        centre = run.episode.states + scale * rng.standard_normal((len(run), 4))
        cloud = centre[:, None] + ratio * scale[:, None] * rng.standard_normal((len(run), members, 4))
        weights = np.full((len(run), members), -np.log(members), np.float32)
        result.append(replace(run, particles=cloud.astype(np.float32), log_weights=weights))
    return result


def test_ensemble_of_the_right_spread_is_reliable() -> None:
    result: Any = DIAGNOSTICS["ensemble"](sampled(1.0))
    assert result.status == "reliable"
    assert result.alarms == ()
    for component in result.components:
        assert component.ratio == pytest.approx(1.0, abs=0.1)
        # 1180 steps; the standard deviation of the share is 0.007.
        assert component.outside == pytest.approx(2 / 31, abs=0.03)
        assert component.correlation > 0.3
        np.testing.assert_allclose(component.ranks.sum(), 1.0)
        np.testing.assert_allclose(component.ranks * len(component.ranks), 1.0, atol=0.5)


@pytest.mark.parametrize(("ratio", "status"), [(0.4, "under-dispersed"), (4.0, "over-dispersed")])
def test_wrong_spread_is_named(ratio: float, status: str) -> None:
    result: Any = DIAGNOSTICS["ensemble"](sampled(ratio))
    assert result.status == status
    assert status in result.verdict
    ends = result.components[0].ranks[[0, -1]].mean() / result.components[0].ranks.mean()
    assert ends > 2.0 if ratio < 1 else ends < 0.2


def test_collapse_is_an_alarm() -> None:
    result: Any = DIAGNOSTICS["ensemble"](sampled(0.001))
    assert "the ensemble collapses: x, y, vx, vy" in result.alarms


def point_estimate(jump: float, steps: int = STEPS) -> Trace:
    """An estimate 0.1 m off, and in two GPS gaps ``jump`` m off, which decreases by half per step afterwards."""
    episode = vehicle.drive(0, steps, gap=(100, 150))
    for start, stop in ((100, 150), (250, 270)):
        episode.observations["gps"][start:stop] = np.nan
        episode.observations["fix"][start:stop] = np.nan
    run = trace(ExternalFilter(Adapter(vehicle.NumpyKalman(), batched=False), vehicle.TASK, "mine"), episode)
    offset = np.full(steps, 0.1)
    for start, stop in ((100, 150), (250, 270)):
        offset[start:stop] = jump
        offset[stop : stop + 10] = 0.1 + (jump - 0.1) * 0.5 ** np.arange(1, 11)
    estimate = episode.states + np.stack([offset, *np.zeros((3, steps))], axis=1)
    return replace(run, estimate_mean=estimate.astype(np.float32), innovation=None, innovation_covariance=None)


def test_outages_and_recovery_of_a_point_estimate() -> None:
    run = point_estimate(6.0)
    result: Any = DIAGNOSTICS["errors"]([run])
    (outage,) = result.outages
    assert (outage.modality, outage.count, outage.longest) == ("gps", 2, pytest.approx(5.0))
    assert outage.during == pytest.approx(6.0, rel=1e-4)
    assert outage.end == pytest.approx(6.0, rel=1e-4)
    assert outage.before == pytest.approx(0.1, rel=1e-3)
    # 0.1 + 5.9 / 2^k <= 0.15 from k = 7, which is index 6 after the end.
    assert outage.recovery == pytest.approx(0.6)
    assert outage.unrecovered == 0
    group = {g.name: g for g in result.groups}["no fix"]
    assert group.position == pytest.approx(6.0, rel=1e-4)
    assert group.bias[0] == pytest.approx(6.0, rel=1e-4)
    assert "outages of gps" in result.verdict
    assert DIAGNOSTICS["innovations"].refusal(run, None) == "filter mine reports no innovations of its measurements"


def test_readings_that_are_better_than_the_estimate_are_reported() -> None:
    run = point_estimate(6.0)
    task = replace(run.task, positions={"gps": (0, 1)})
    wrong = replace(run, estimate_mean=run.estimate_mean + np.float32(3.0), episode=replace(run.episode, task=task))
    result: Any = DIAGNOSTICS["errors"]([wrong])
    assert result.worse == ("gps",)
    # The norm of two errors of 0.3 m.
    assert result.readings["gps"][0] == pytest.approx(0.3 * np.sqrt(2.0), rel=0.1)
    assert "The readings of gps are closer to the truth" in result.verdict
    right: Any = DIAGNOSTICS["errors"]([replace(run, episode=replace(run.episode, task=task))])
    assert "gps" in right.readings


def test_a_point_estimator_has_diagnostics() -> None:
    run = point_estimate(1.0)
    none = np.full_like(run.estimate_covariance, np.nan)
    results = quick(replace(run, estimate_covariance=none, accepted=None, modalities=()))
    assert set(results) == {"errors"}
    assert set(quick(sampled(1.0)[0])) == {"consistency", "innovations", "errors", "ensemble"}
    for result in quick(sampled(1.0)[0]).values():
        assert result.views()["verdict"]
