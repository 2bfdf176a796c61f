"""Outages by mask and by duration, on planted traces of a point estimator with known answers."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beliefscope.datasets.covariate import Covariate
from beliefscope.datasets.episode import hold
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.failures.step_scores import EpisodeScores, Survey
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.outages import missing_steps, without_reading
from beliefscope.inspect.trace import Trace, trace

sys.path.insert(0, str(Path(__file__).parents[2] / "filters" / "external"))
import vehicle_filters as vehicle

SECONDS = replace(
    vehicle.TASK,
    dt=1.0,
    observations={"gps": (2,), "speed": (1,)},
    modalities={"gps": ("gps",), "speed": ("speed",)},
    covariates={"fix": Covariate("boolean")},
    masks={"gps": "fix"},
    positions={"gps": (0, 1)},
    warmup=0,
)


def point_estimate(gaps: dict[tuple[int, int], float], steps: int = 1000, every: int = 1, bias: float = 0.1) -> Trace:
    """A point estimator that is off by ``bias`` m in x, and by given distances in gaps of a GPS which is off by 0.5 m.

    The GPS has a reading at every ``every``-th step outside of the gaps and repeats it at others. A step lasts 1 s.
    """
    drive = vehicle.drive(0, steps)
    fix = np.arange(steps) % every == 0
    offset = np.full(steps, bias)
    for (start, stop), distance in gaps.items():
        fix[start:stop] = False
        offset[start:stop] = distance
    gps = hold(drive.states[:, :2] + np.float32([0.5, 0.0]), fix)
    episode = replace(
        drive,
        task=SECONDS,
        dt=1.0,
        observations={"gps": gps, "speed": drive.observations["speed"]},
        covariates={"fix": fix.astype(np.float32)},
    )
    estimate = episode.states + np.stack([offset, *np.zeros((3, steps))], axis=1).astype(np.float32)
    run = trace(ExternalFilter(Adapter(origin), SECONDS, "mine"), episode)
    assert not run.has_covariance
    return replace(run, estimate_mean=estimate)


def origin(observations: dict[str, np.ndarray], controls: np.ndarray) -> np.ndarray:
    return np.zeros((*controls.shape[:2], 4))


def errors(*traces: Trace) -> Any:
    return DIAGNOSTICS["errors"](traces)


def test_outages_of_a_masked_sensor_by_duration() -> None:
    gaps = {(100, 105): 3.0, (200, 260): 2.0, (400, 461): 20.0, (600, 601): 50.0}
    result = errors(point_estimate(gaps))
    (outage,) = result.outages
    assert (outage.modality, outage.count, outage.longest) == ("gps", 3, 61.0)  # one step without a fix is no outage
    assert [(c.low, c.high, c.count) for c in outage.classes] == [(1, 10, 1), (10, 60, 1), (60, 600, 1)]
    total = 5 * 9 + 60 * 4 + 61 * 400 + 2500 + 873 * 0.01
    # float32 positions of up to 1 km have a spacing of 6e-5 m.
    assert [c.square for c in outage.classes] == pytest.approx([9.0, 4.0, 400.0], rel=1e-3)
    assert [c.share for c in outage.classes] == pytest.approx([45 / total, 240 / total, 24400 / total], rel=1e-3)
    assert outage.dominant is not None
    assert (outage.dominant.low, outage.dominant.count) == (60, 1)
    assert "those over 60 s have 90 % in 6 %, with an error of 2000 cm" in result.verdict
    assert [table.title for table in result.tables()][1:3] == ["Outages", "Outages by duration"]


def test_shorter_outages_are_named_if_they_have_most_of_the_error() -> None:
    (outage,) = errors(point_estimate({(100, 112): 20.0, (200, 214): 20.0, (400, 461): 2.0})).outages
    assert outage.dominant is not None
    assert (outage.dominant.low, outage.dominant.count) == (10, 3)
    assert outage.dominant.square == pytest.approx((26 * 400 + 61 * 4) / 87, rel=1e-3)
    (small,) = errors(point_estimate({(100, 161): 0.1})).outages
    assert small.dominant is None


def test_outages_of_several_runs_are_pooled() -> None:
    runs = [point_estimate({(100, 161): 20.0}), point_estimate({(300, 800): 5.0})]
    (outage,) = errors(*runs).outages
    (c,) = outage.classes
    assert (c.count, c.steps) == (2, pytest.approx(561 / 2000))
    assert c.square == pytest.approx((61 * 400 + 500 * 25) / 561, rel=1e-3)


def test_steps_between_readings_of_a_slow_sensor_are_no_outage() -> None:
    slow = point_estimate({(400, 460): 20.0}, every=5)
    assert without_reading(slow.episode, "gps").sum() == 812
    missing = missing_steps(slow)["gps"]
    # The last reading before the gap is at step 395, the first one after it at step 460.
    assert np.flatnonzero(missing).tolist() == list(range(396, 460))
    assert errors(point_estimate({}, every=5)).outages == ()


def test_readings_are_compared_at_steps_with_a_reading_only() -> None:
    gaps = {(100, 105): 3.0, (200, 260): 2.0}
    worse = errors(point_estimate(gaps, bias=2.0))
    assert worse.readings["gps"] == pytest.approx((0.5, 2.0), rel=1e-3)
    assert worse.alarms[0] == "the estimate is worse than the readings of gps"
    assert "The readings of gps are closer to the truth (50 cm) than the estimate in the same steps (200 cm)." in (
        worse.verdict
    )
    better = errors(point_estimate(gaps, every=5, bias=0.2))
    assert better.readings["gps"] == pytest.approx((0.5, 0.2), rel=1e-3)
    assert better.alarms == ()


def test_groups_of_a_slow_sensor_are_its_outages() -> None:
    """Steps between two readings at the usual interval have no group of their own."""
    run = point_estimate({(400, 500): 2.0}, every=5)
    groups = measures.shaded_groups(run)
    assert np.flatnonzero(groups["no fix"])[[0, -1]].tolist() == [396, 499]
    assert {"fix", "no fix"} <= set(measures.pooled_phases([run, run]))
    steady = point_estimate({}, every=5)
    assert not measures.shaded_groups(steady)["no fix"].any()
    assert not {"fix", "no fix"} & set(measures.pooled_phases([steady, steady]))
    assert {"fix", "no fix"} <= set(measures.pooled_phases([steady, run]))
    phases = [Survey.from_episodes([EpisodeScores.from_trace(trace_)]).phases for trace_ in (run, steady)]
    assert {"fix", "no fix"} <= set(phases[0])
    assert "fix" not in phases[1], "it would be the phase of all other steps"


def test_steps_count_where_the_main_error_is_known() -> None:
    run = point_estimate({(100, 150): 2.0})
    states = run.episode.states.copy()
    states[:, 2:] = np.nan  # components that no map has
    partly = replace(run, episode=replace(run.episode, states=states))
    (expected, *_), (group, *_) = (DIAGNOSTICS["errors"]([each]).groups for each in (run, partly))
    assert (group.steps, group.position) == (expected.steps, expected.position)
    unknown = replace(run, episode=replace(run.episode, states=np.full_like(states, np.nan)))
    assert DIAGNOSTICS["errors"].refusal(unknown, None) == measures.UNKNOWN_TRUTH
