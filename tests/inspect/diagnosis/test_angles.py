"""Sensors of angles that wrap around, such as bearings."""

from __future__ import annotations

import numpy as np
import pytest

from beliefscope.datasets.covariate import Covariate
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Component, Task
from beliefscope.inspect.diagnosis.checks.sensors import sensor_statistics
from beliefscope.inspect.diagnosis.checks.vectors import angle_channels
from beliefscope.inspect.statistics.signals import is_angle


@pytest.mark.parametrize("bias", [0.0, 0.4])
@pytest.mark.parametrize("start", [-np.pi, 0.0])
def test_angles_are_those_that_jump_by_a_turn(bias: float, start: float) -> None:
    rng = np.random.default_rng(0)
    course = np.cumsum(rng.normal(0.1, 0.1, 200))
    assert is_angle((course - start) % (2.0 * np.pi) + start + bias)
    assert not is_angle(course % 1.0 * 6.0 + 4.0), "another range"
    assert not is_angle(rng.uniform(-3.0, 3.0, 200)), "noise jumps by other amounts"
    assert not is_angle(0.01 * course), "no jump"


def boat(bearings: np.ndarray, seen: np.ndarray) -> Episode:
    """An episode with bearings (T, d) that may be absent, of which nothing else is known."""
    task = Task(
        "boat",
        (Component("x", "m"),),
        observations={"bearing": bearings.shape[1:]},
        modalities={"radar": ("bearing",)},
        masks={"bearing": "seen"},
        covariates={"seen": Covariate("boolean")},
        control_size=0,
        dt=0.1,
    )
    count = len(bearings)
    covariates = {"seen": seen.astype(np.float32)}
    return Episode(task, np.zeros((count, 1)), np.zeros((count, 0)), {"bearing": bearings}, covariates=covariates)


def test_bearings_have_the_statistics_of_continuous_angles() -> None:
    """A turn more or less in the readings changes nothing, also in windows and between absent readings."""
    rng = np.random.default_rng(1)
    course = np.cumsum(rng.normal(0.05, 0.05, (100, 2)), axis=0) + rng.normal(0.0, 0.02, (100, 2))
    seen = np.arange(100) % 7 != 0

    def statistics(bearings: np.ndarray) -> dict[str, float]:
        return sensor_statistics(boat(np.where(seen[:, None], bearings, 9.0), seen), None)

    continuous, jumping = statistics(course), statistics((course + np.pi) % (2.0 * np.pi) - np.pi)
    assert np.abs(np.diff(course, axis=0)).max() < 1.0 < np.ptp(course)
    assert continuous.keys() == jumping.keys()
    for name, value in continuous.items():
        turns = (jumping[name] - value) / (2.0 * np.pi) if name.startswith("level/") else 0.0
        assert jumping[name] == pytest.approx(value + 2.0 * np.pi * round(turns), abs=1e-4, nan_ok=True), name


def test_bearings_in_bursts_are_angles_although_they_jump_between_them() -> None:
    rng = np.random.default_rng(3)
    course = 0.2 * np.arange(120) - 1.46 + rng.normal(0.0, 0.02, 120)
    seen = np.arange(120) % 20 < 8
    values = ((course + np.pi) % (2.0 * np.pi) - np.pi)[seen]
    assert not is_angle(values)
    assert is_angle(values, np.diff(np.flatnonzero(seen)) == 1)
    readings = np.zeros((120, 1))
    readings[seen, 0] = values
    assert angle_channels(boat(readings, seen), "bearing") == [0]
