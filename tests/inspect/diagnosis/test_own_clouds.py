"""Causes in the point clouds of a user's task: points on a box that moves in front of a lidar."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.external.load import as_external
from beliefscope.inspect.diagnosis.catalog import causes_of
from beliefscope.inspect.diagnosis.checks.readings import without_explained
from beliefscope.inspect.diagnosis.checks.sensors import sensor_statistics
from beliefscope.inspect.diagnosis.scoring import applicable, explain, probabilities
from beliefscope.inspect.diagnosis.undo.run_inputs import RunInputs
from beliefscope.inspect.diagnosis.undo.undo import undo
from beliefscope.inspect.diagnostics.healthy_comparison import compare, with_critical_values
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.diagnostics.statistic_kinds import label_of
from beliefscope.inspect.healthy import SensorRecord, sensor_record

POINTS = 60
TASK = Task(
    "yard",
    (Component("x", "m"), Component("y", "m")),
    {"cloud": (POINTS, 3)},
    {"lidar": ("cloud",)},
    0,
    0.05,
    clouds=("cloud",),
)


def slide(seed: int, steps: int = 80) -> Episode:
    rng = np.random.default_rng(seed)
    phase, rate = rng.uniform(0.0, 2 * np.pi, 2), rng.uniform(0.6, 1.4, 2)
    states = np.sin(np.arange(steps)[:, None] * 0.1 * rate + phase) * [1.5, 0.8] + [3.0, 0.5]
    cloud = np.zeros((steps, POINTS, 3))
    cloud[..., :2] = states[:, None] + rng.uniform(-0.3, 0.3, (steps, POINTS, 2))
    cloud[..., 2] = rng.uniform(0.0, 0.5, (steps, POINTS))
    cloud = cloud + rng.normal(0.0, 0.02, cloud.shape)
    cloud[rng.random((steps, POINTS)) < 0.05] = 0.0  # no return
    return Episode(TASK, states, observations={"cloud": cloud.astype(np.float32)})


@cache
def record() -> SensorRecord:
    return sensor_record([slide(seed) for seed in range(30)])


def profile() -> HealthyProfile:
    rows = record().rows
    values = {name: np.array([row.get(name, np.nan) for row in rows]) for name in rows[0]}
    return HealthyProfile("yard", len(rows), None, values, record().reference, record().readings)


def moved(cloud: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Points with a change; absent ones stay absent."""
    return np.where((cloud != 0.0).any(-1, keepdims=True), cloud + change, 0.0)


CHANGES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "noise": lambda cloud: moved(cloud, np.random.default_rng(0).normal(0.0, 0.4, cloud.shape)),
    "bias": lambda cloud: moved(cloud, np.array([0.2, 0.0, 0.0])),
    "gain": lambda cloud: 1.3 * cloud,
    "sign": lambda cloud: cloud * [1.0, -1.0, 1.0],
    "axes": lambda cloud: cloud[..., [1, 0, 2]],
    "holes": lambda cloud: cloud * (np.random.default_rng(0).random((*cloud.shape[:2], 1)) < 0.7),
    "stuck": lambda cloud: np.concatenate([cloud[:40], np.repeat(cloud[40:41], 40, axis=0)]),
    "delay": lambda cloud: np.concatenate([np.repeat(cloud[:1], 4, axis=0), cloud[:-4]]),
}


@pytest.mark.first(3)
@pytest.mark.slow
@pytest.mark.parametrize("mechanism", CHANGES)
def test_faults_of_a_point_cloud_are_named(mechanism: str) -> None:
    tested = []
    for seed in range(30, 40):
        episode = slide(seed)
        changed = {"cloud": CHANGES[mechanism](episode.observations["cloud"]).astype(np.float32)}
        row = sensor_statistics(replace(episode, observations=changed), record().reference, record().readings)
        tested.append(without_explained(row))
    deviations = with_critical_values(profile(), compare(profile(), tested, task=TASK), 0.02)
    causes = applicable(causes_of(TASK), [d.statistic for d in deviations])
    result = probabilities({c.name: explain(c, deviations) for c in causes})
    assert max(result, key=lambda name: result[name]) == f"cloud.{mechanism}"
    assert result[f"cloud.{mechanism}"] > 0.7


def test_channels_have_names_and_readings_are_not_corrected() -> None:
    assert label_of("level/cloud 3/free motion", TASK) == "level of cloud (spread)"
    flat = replace(TASK, observations={"cloud": (POINTS, 2)})
    assert label_of("level/cloud z/free motion", flat) == "level of cloud (spread)"

    def still(*, observations: object, controls: np.ndarray) -> np.ndarray:
        return np.zeros((*controls.shape[:-1], 2))

    inputs = RunInputs(as_external(still, "still", TASK), {0: slide(50)}, 1, frozenset({0}), healthy=profile())
    assert all(undo(f"{name} cloud", inputs, {}) is None for name in ("tare", "detrend", "scale", "rearrange"))
