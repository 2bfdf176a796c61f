"""Shapes of synthetic maps: flat, round, ridge and ring, at both sizes of the page."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from beliefscope.datasets.simulation.push import PUSH
from beliefscope.inspect.diagnostics.likelihood_maps import median_interval
from beliefscope.inspect.maps.map_engine import COARSE, FINE, LikelihoodMap
from beliefscope.inspect.maps.map_statistics import MapStatistics, measure_maps
from beliefscope.inspect.maps.shape import SHAPES

HALF = 0.135
Centre = tuple[float, float]


class Grid:
    """Log-likelihoods over the square of a map."""

    def __init__(self, size: int) -> None:
        self.offsets = (((np.arange(size) + 0.5) / size * 2.0 - 1.0) * HALF).astype(np.float32)
        self.x, self.y = np.meshgrid(self.offsets, self.offsets)

    def peak(self, centre: Centre = (0.0, 0.0), sd: float = 0.01) -> np.ndarray:
        return -0.5 * ((self.x - centre[0]) ** 2 + (self.y - centre[1]) ** 2) / sd**2

    def ring(self, centre: Centre = (0.0, 0.0), radius: float = 0.06, sd: float = 0.008) -> np.ndarray:
        return -0.5 * ((np.hypot(self.x - centre[0], self.y - centre[1]) - radius) / sd) ** 2

    def ridge(self, angle: float, sd: float) -> np.ndarray:
        return -0.5 * ((self.x * math.sin(angle) - self.y * math.cos(angle)) / sd) ** 2

    def arc(self, span: float) -> np.ndarray:
        beyond = np.maximum(np.abs(np.arctan2(self.y, self.x)) - span / 2.0, 0.0)
        return self.ring(radius=0.07) - 0.5 * (beyond / 0.1) ** 2

    def measure(self, *layers: np.ndarray) -> MapStatistics:
        names, log = tuple(f"layer{i}" for i in range(len(layers))), np.stack(layers).astype(np.float32)
        map_ = LikelihoodMap(0, math.nan, names, self.offsets, self.offsets, np.zeros(2, np.float32), log)
        run: Any = SimpleNamespace(task=PUSH, episode=SimpleNamespace(states=np.zeros((1, 2))))
        return measure_maps([map_], run)


@pytest.mark.parametrize("size", [COARSE, FINE])
def test_shapes(size: int) -> None:
    grid = Grid(size)
    examples = {
        "flat": [
            np.zeros_like(grid.x),
            3.0 * grid.x,
            6.0 * grid.x,  # 1.6 nats
            grid.peak((0.02, 0.0), 0.8 * HALF),  # 1.9 nats
            np.log1p(-0.999 * np.exp(grid.peak(sd=0.04))),  # everywhere but near the effector
        ],
        "round": [
            grid.peak(),
            grid.peak(sd=0.6 * HALF),  # 2.8 nats
            grid.peak((0.1, -0.05), 0.02),
            grid.peak((0.001, 0.0), 0.002),  # within a cell
            grid.peak((HALF / size, HALF / size), 0.003),  # on a corner of cells
            np.logaddexp(grid.peak(sd=0.006), -5.0),  # with a background that has most of p
        ],
        "ridge": [
            grid.ridge(0.5, 0.01),
            grid.ridge(0.5, 0.015) + grid.peak(sd=0.05),
            grid.arc(math.pi / 2.0),
            np.logaddexp(grid.peak((-0.06, 0.0)), grid.peak((0.06, 0.0))),  # two peaks on a circle
        ],
        "cut by border": [
            grid.peak((HALF, HALF), 0.06),  # into a corner
            grid.peak((0.1, 0.0), 0.04),
            grid.peak((HALF, 0.06), 0.1),
        ],
        "ring": [
            grid.ring(),
            grid.ring((0.03, -0.05), 0.05),
            grid.ring(sd=0.015),
            grid.arc(4.2),
            np.logaddexp(grid.ring((0.02, 0.0), 0.05), -4.0),
        ],
    }
    for shape, layers in examples.items():
        assert [SHAPES[index] for index in grid.measure(*layers).shape[0]] == [shape] * len(layers)


@pytest.mark.parametrize("size", [COARSE, FINE])
def test_fitted_circle(size: int) -> None:
    grid = Grid(size)
    result = grid.measure(grid.ring((0.03, -0.05), 0.05, 0.006), np.logaddexp(grid.ring((0.02, 0.01)), -5.0))
    np.testing.assert_allclose(result.ring_centre[0], [(0.03, -0.05), (0.02, 0.01)], atol=1e-3)
    np.testing.assert_allclose(result.ring_radius[0], [0.05, 0.06], atol=1e-3)
    assert (result.ring_spread[0] < 0.1).all()
    assert (result.ring_coverage[0] > 0.95).all()
    np.testing.assert_allclose(result.elongation[0], 1.0, atol=0.1)


def test_rotation_and_shift_change_only_the_centre() -> None:
    grid = Grid(FINE)
    layer = grid.arc(4.2)
    before, after = grid.measure(layer), grid.measure(np.rot90(layer, -1))  # rows increase upwards
    np.testing.assert_allclose(after.ring_radius, before.ring_radius)
    np.testing.assert_allclose(after.ring_centre[0, 0], before.ring_centre[0, 0] @ [[0, 1], [-1, 0]], atol=1e-9)
    np.testing.assert_allclose(after.ring_coverage, before.ring_coverage, atol=1e-6)


@pytest.mark.slow
@pytest.mark.long
def test_interval_of_the_median_covers_over_trajectories() -> None:
    """Trajectory effects: 95 % intervals of 300 simulated surveys. An interval over independent steps covers 30 %."""
    rng = np.random.default_rng(0)
    trajectory = np.repeat(np.arange(12), 40)
    covered = 0
    for _ in range(300):
        values = rng.normal(size=12)[trajectory] + 0.3 * rng.normal(size=trajectory.size)
        _, low, high = median_interval(values, trajectory)
        covered += low <= 0.0 <= high
    assert covered >= 0.92 * 300


def test_interval_needs_five_trajectories() -> None:
    values = np.arange(8.0)
    median, low, high = median_interval(values, np.repeat(np.arange(4), 2))
    assert median == 3.5
    assert np.isnan(low)
    assert np.isnan(high)
