"""Kalman equations of a filter that does not linearise."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray

import beliefscope as bs
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.inspect.diagnostics.kalman_equations import check_equations, jacobian_statistics

pytestmark = pytest.mark.slow

Array = NDArray[np.float64]

DT, SPREAD = 0.25, 4.0
"""s; n + lambda of the sigma points, which are two standard deviations from the mean."""
PROCESS, NOISE = np.array([0.02, 0.02, 0.1, 0.1]), np.array([0.6, 0.03, 0.1])
TASK = bs.Task(
    name="tracked",
    components=tuple(bs.Component(name, unit) for name, unit in zip("xyvw", ("m", "m", "m/s", "m/s"), strict=True)),
    observations={"radar": (3,)},
    modalities={"radar": ("radar",)},
    control_size=0,
    dt=DT,
)


def readings_of(states: Array) -> Array:
    """Range, bearing and range rate (..., 3); the targets are not near the angle of pi."""
    x, y, v, w = np.moveaxis(states, -1, 0)
    distance = np.hypot(x, y)
    return np.stack([distance, np.arctan2(y, x), (x * v + y * w) / distance], -1)


WALL = 12.5
"""x in m at which targets turn back, in some tests."""


def move(states: Array, wall: float = np.inf) -> Array:
    moved = states + DT * np.concatenate([states[..., 2:], np.zeros_like(states[..., 2:])], -1)
    moved[..., 0] -= 2.0 * np.maximum(moved[..., 0] - wall, 0.0)
    return moved


def track(seed: int, steps: int = 28, wall: float = np.inf) -> bs.Episode:
    """Of so few steps that one of them is repeated at the start."""
    rng = np.random.default_rng(seed)
    state = np.array([12.0, 0.0, 0.5, 0.3]) + rng.normal(0.0, [1.5, 2.0, 0.3, 0.3])
    states = np.array([state := move(state, wall) + rng.normal(0.0, PROCESS) for _ in range(steps)])
    readings = {"radar": readings_of(states) + rng.normal(0.0, NOISE, (steps, 3))}
    return bs.Episode(TASK, states, np.zeros((steps, 0)), readings, seed=seed, split="test")


class Unscented:
    """An unscented Kalman filter.

    factor: of its cross-covariance of state and bearing. reduction: of that of the covariance by an update.
    """

    task: ClassVar = TASK

    def __init__(self, factor: float = 1.0, reduction: float = 1.0, wall: float = np.inf) -> None:
        self.reduction, self.wall = reduction, wall
        self.factor = np.array([1.0, factor, 1.0])
        self.weights = np.full(9, 0.5 / SPREAD)
        self.weights[0] = 1.0 - 4.0 / SPREAD
        self.squares = self.weights + np.array([2.0, *[0.0] * 8])  # of covariances, for normal states

    def initialize_beliefs(self, *, mean: Any, covariance: Any) -> None:
        self.mean, self.covariance = mean, covariance

    def points(self) -> Array:
        root = np.linalg.cholesky(SPREAD * self.covariance).T
        return np.asarray(self.mean + np.concatenate([np.zeros((1, 4)), root, -root]))

    def __call__(self, *, observations: dict[str, Any], controls: Any) -> dict[str, Any]:
        moved = move(self.points(), self.wall)
        self.mean = self.weights @ moved
        d = moved - self.mean
        self.covariance = d.T @ (self.squares[:, None] * d) + np.diag(PROCESS**2)
        prediction = {"predicted_mean": self.mean[None], "predicted_covariance": self.covariance[None]}
        points = self.points()
        expected = readings_of(points)
        d, e = points - self.mean, expected - self.weights @ expected
        size = e.T @ (self.squares[:, None] * e) + np.diag(NOISE**2)
        gain = d.T @ (self.squares[:, None] * e) * self.factor @ np.linalg.inv(size)
        innovation = observations["radar"] - self.weights @ expected
        self.mean = self.mean + gain @ innovation
        self.covariance = self.covariance - self.reduction * gain @ size @ gain.T
        return prediction | {
            "estimate_mean": self.mean,
            "estimate_covariance": self.covariance,
            "innovation": innovation[None],
            "innovation_covariance": size[None],
        }


def loaded(filter_: Unscented) -> ExternalFilter:
    adapter = bs.Adapter(filter_, batched=False, modalities=("radar",), initial_std=(2.0, 2.0, 2.0, 2.0), task=TASK)
    return bs.load_filter(adapter, name="unscented")


def alarms(filter_: Unscented) -> tuple[str, ...]:
    checkpoint = loaded(filter_)
    return check_equations([bs.trace(checkpoint, [track(seed)]) for seed in range(6)], checkpoint).alarms


def test_wide_first_beliefs_do_not_make_a_right_filter_wrong() -> None:
    """Sigma points over which the bearing is curved have another covariance than its derivative."""
    assert alarms(Unscented()) == ()


@pytest.mark.parametrize("reduction", [1.0, 0.5])
def test_reductions_of_the_covariance_are_those_of_nearly_linear_steps(reduction: float) -> None:
    """Where a target turns back at a wall, the prediction has two derivatives."""
    checkpoint = loaded(Unscented(reduction=reduction, wall=WALL))
    traces = [bs.trace(checkpoint, [track(seed, 80, WALL)]) for seed in range(8)]
    slopes = np.array([jacobian_statistics(trace, checkpoint)["covariance update//all"] for trace in traces])
    np.testing.assert_allclose(slopes[np.isfinite(slopes)], reduction, atol=0.03)
    assert np.isfinite(slopes).sum() >= 4


def test_a_wrong_gain_of_one_channel_is_still_named() -> None:
    assert "updates with radar" in alarms(Unscented(factor=0.6))[0]
