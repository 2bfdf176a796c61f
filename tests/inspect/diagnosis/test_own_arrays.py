"""Causes in the arrays of a user's task: a tactile grid whose pressure follows the position and the load of a ball."""

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
from beliefscope.inspect.diagnosis.checks.measurements import measurement_model_statistics
from beliefscope.inspect.diagnosis.checks.readings import without_explained
from beliefscope.inspect.diagnosis.checks.sensors import localise, sensor_statistics
from beliefscope.inspect.diagnosis.scoring import applicable, explain, probabilities
from beliefscope.inspect.diagnosis.undo.run_inputs import RunInputs
from beliefscope.inspect.diagnosis.undo.undo import undo
from beliefscope.inspect.diagnostics.healthy_comparison import Deviation, compare, with_critical_values
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
from beliefscope.inspect.diagnostics.statistic_kinds import label_of
from beliefscope.inspect.healthy import SensorRecord, sensor_record
from beliefscope.inspect.trace import trace

TASK = Task(
    "palm",
    (Component("x", "m"), Component("y", "m"), Component("load", "N")),
    {"grid": (6, 8)},
    {"touch": ("grid",)},
    0,
    0.05,
    arrays=("grid",),
)
PLACES = np.stack(np.meshgrid(np.linspace(-0.03, 0.03, 8), np.linspace(-0.02, 0.02, 6)), axis=-1)


def roll(seed: int, steps: int = 80) -> Episode:
    rng = np.random.default_rng(seed)
    phase, rate = rng.uniform(0.0, 2 * np.pi, 3), rng.uniform(0.6, 1.4, 3)
    states = np.sin(np.arange(steps)[:, None] * 0.1 * rate + phase) * [0.018, 0.012, 0.6] + [0.0, 0.0, 1.5]
    distance = np.square(PLACES - states[:, None, None, :2]).sum(-1)
    grid = states[:, 2, None, None] * np.exp(-distance / (2 * 0.01**2)) + rng.normal(0.0, 0.03, (steps, 6, 8))
    return Episode(TASK, states, observations={"grid": grid.astype(np.float32)})


@cache
def record() -> SensorRecord:
    return sensor_record([roll(seed) for seed in range(30)])


def deviations_of(change: Callable[[np.ndarray], np.ndarray]) -> list[Deviation]:
    rows = record().rows
    values = {name: np.array([row.get(name, np.nan) for row in rows]) for name in rows[0]}
    profile = HealthyProfile("palm", len(rows), None, values, record().reference, record().readings)
    tested = []
    for seed in range(30, 40):
        episode = roll(seed)
        changed = {"grid": change(episode.observations["grid"]).astype(np.float32)}
        row = sensor_statistics(replace(episode, observations=changed), record().reference, record().readings)
        tested.append(without_explained(row))
    return with_critical_values(profile, compare(profile, tested, task=TASK), 0.02)


def stuck(grid: np.ndarray) -> np.ndarray:
    return np.concatenate([grid[:40], np.repeat(grid[40:41], 40, axis=0)])


def noisy(grid: np.ndarray) -> np.ndarray:
    return grid + np.random.default_rng(0).normal(0.0, 0.1, grid.shape)


def dead(grid: np.ndarray) -> np.ndarray:
    result = grid.copy()
    result[:, 2, 3] = 0.0
    return result


def with_holes(grid: np.ndarray) -> np.ndarray:
    return np.where(np.random.default_rng(0).random(grid.shape) < 0.15, 0.0, grid)


CHANGES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "noise": noisy,
    "bias": lambda grid: grid + 0.15,
    "drift": lambda grid: grid + np.linspace(0.0, 0.3, len(grid))[:, None, None],
    "gain": lambda grid: 1.5 * grid,
    "dead": dead,
    "holes": with_holes,
    "stuck": stuck,
    "saturation": lambda grid: np.minimum(grid, 1.0),
    "shift": lambda grid: np.roll(grid, 1, axis=2),
    "sign": lambda grid: -grid,
    "axes": lambda grid: grid[:, :, ::-1],
    "delay": lambda grid: np.concatenate([np.repeat(grid[:1], 4, axis=0), grid[:-4]]),
}


def still(*, observations: object, controls: np.ndarray) -> np.ndarray:
    return np.zeros((*controls.shape[:-1], 3))


@pytest.mark.first(4)
@pytest.mark.slow
@pytest.mark.parametrize("mechanism", CHANGES)
def test_faults_of_an_array_are_named(mechanism: str) -> None:
    deviations = deviations_of(CHANGES[mechanism])
    causes = applicable(causes_of(TASK), [d.statistic for d in deviations])
    result = probabilities({c.name: explain(c, deviations) for c in causes})
    assert max(result, key=lambda name: result[name]) == f"grid.{mechanism}"
    assert result[f"grid.{mechanism}"] > 0.8


def test_an_unchanged_array_has_no_alarm() -> None:
    assert not any(d.alarm for d in deviations_of(lambda grid: grid))


def test_channels_have_names_and_steps_of_the_fault_are_found() -> None:
    assert label_of("reading bias/grid 0/all", TASK).startswith("error of grid (mean) against")
    assert label_of("level/touch grid 3/all", TASK) == "level of touch (grid column)"
    episode = roll(1)
    episode = replace(episode, observations={"grid": stuck(episode.observations["grid"])})
    assert localise("stuck/grid/all", episode, None) == (41, 79)
    assert localise("dead/grid/all", episode, None) is None
    part = roll(1).observations["grid"].copy()
    part[30:50] += np.random.default_rng(2).normal(0.0, 0.3, part[30:50].shape)
    first, last = localise("noise/grid/all", replace(episode, observations={"grid": part}), None) or (0, 0)
    assert abs(first - 30) < 4
    assert abs(last - 49) < 4


@pytest.mark.parametrize(
    ("name", "mechanism"), [("level", "bias"), ("divide", "gain"), ("negate", "sign"), ("reorder", "axes")]
)
def test_faults_of_arrays_are_undone(name: str, mechanism: str) -> None:
    """Up to a tenth of the noise, 0.03, of the mean of all elements, and 2 % of the gain; other episodes stay."""
    profile = HealthyProfile("palm", len(record().rows), None, {}, record().reference, record().readings)
    episode, change = roll(50), CHANGES[mechanism]
    wrong = replace(episode, observations={"grid": change(episode.observations["grid"]).astype(np.float32)})
    inputs = RunInputs(as_external(still, "still", TASK), {0: wrong, 1: wrong}, 1, frozenset({0}), healthy=profile)
    result = undo(f"{name} grid", inputs, {d.statistic: d for d in deviations_of(change)})
    assert result is not None
    np.testing.assert_allclose(result.episodes[0].observations["grid"], episode.observations["grid"], 0.02, 0.003)
    assert result.episodes[1] is wrong
    assert f"{name} grid" in next(c.undo for c in causes_of(TASK) if c.name == f"grid.{mechanism}")


def test_the_right_order_and_unknown_channels_are_left() -> None:
    profile = HealthyProfile("palm", len(record().rows), None, {}, record().reference, record().readings)
    inputs = RunInputs(as_external(still, "still", TASK), {0: roll(50)}, 1, frozenset({0}), healthy=profile)
    assert undo("reorder grid", inputs, {}) is None
    assert undo("reorder grid", replace(inputs, healthy=None), {}) is None
    assert undo("level grid", inputs, {}) is None
    assert undo("divide grid", inputs, {}) is None


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_short_episodes_have_statistics(steps: int) -> None:
    values = sensor_statistics(roll(0, steps), record().reference, record().readings)
    assert ("noise/grid/all" in values) == (steps > 2)


def test_a_vector_among_the_arrays_has_the_causes_of_vectors() -> None:
    vector = replace(TASK, observations={"grid": (6,)})
    names = [cause.name for cause in causes_of(vector)]
    assert names.count("grid.bias") == names.count("grid.sign") == 1
    assert "grid.dead" not in names


def test_innovations_of_arrays_are_not_compared_with_their_channels() -> None:
    """An external filter may report an innovation of as many columns as the array has elements."""

    def reports(*, observations: dict[str, np.ndarray], controls: np.ndarray) -> dict[str, np.ndarray]:
        leading = controls.shape[:-1]
        return {
            "estimate_mean": np.zeros((*leading, 3)),
            "estimate_covariance": np.tile(np.eye(3), (*leading, 1, 1)),
            "predicted_mean": np.zeros((*leading, 1, 3)),
            "predicted_covariance": np.tile(np.eye(3), (*leading, 1, 1, 1)),
            "innovation": observations["grid"].reshape(*leading, 1, 48),
            "innovation_covariance": np.tile(np.eye(48), (*leading, 1, 1, 1)),
        }

    run = trace(as_external(reports, "reports", TASK), roll(0))
    assert not any("grid" in name for name in measurement_model_statistics(run, record().readings))
