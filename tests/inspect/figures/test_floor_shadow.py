"""Floor shadow: mass, position and width in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from beliefscope.inspect.figures import floor_shadow
from beliefscope.inspect.figures.floor_shadow import CELLS, DARKNESS, DENSITY, PENUMBRA, FloorShadow
from beliefscope.inspect.figures.scene_shapes import ColoredMesh

SIDE = 2.0  # m
SQUARE = 0.2  # m, side of the horizontal mesh


def shadow() -> FloorShadow:
    corners = SQUARE * np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]], np.float32)
    mesh = ColoredMesh(1, (0, 0, 0), 1.0, corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    return FloorShadow([mesh], (0.4, 0.0), SIDE)


def optical_depth(position: tuple[float, float, float]) -> np.ndarray:
    positions = np.array([(0.0, 0.0, 0.0), position])
    opacity = shadow().opacity(positions, np.tile(np.eye(3), (2, 1, 1)))
    assert opacity.shape == (CELLS, CELLS)
    assert 0.0 <= opacity.min() <= opacity.max() < DARKNESS
    return -np.log1p(-opacity / DARKNESS)


@pytest.mark.parametrize("height", [0.0, 0.3, 1.0])
def test_mass_centre_and_width(height: float) -> None:
    depth = optical_depth((0.3, -0.2, height))
    cell = SIDE / CELLS
    ticks = (np.arange(CELLS) + 0.5) * cell - SIDE / 2
    mass = depth.sum() * cell**2
    assert mass == pytest.approx(DENSITY * SQUARE**2, rel=1e-3)  # sums over cells replace integrals
    centre = [(depth.sum(axis=axis) @ ticks) / depth.sum() for axis in (0, 1)]
    # The standard error of the mean of the sampled points.
    error = 4.0 * SQUARE / np.sqrt(12.0 * floor_shadow.SAMPLES)
    assert centre == pytest.approx([0.3 - 0.4, -0.2], abs=error)
    variance = (depth.sum(axis=0) @ (ticks - centre[0]) ** 2) / depth.sum()
    expected = (PENUMBRA[0] + PENUMBRA[1] * height) ** 2 + SQUARE**2 / 12.0
    assert variance == pytest.approx(expected, rel=0.15)  # of 400 points


def test_a_moved_body_moves_its_shadow() -> None:
    cell = SIDE / CELLS
    first, second = optical_depth((0.4, 0.0, 0.2)), optical_depth((0.4 + 3 * cell, 0.0, 0.2))
    np.testing.assert_allclose(second[:, 3:], first[:, :-3], atol=1e-12)  # sums in another order


def test_a_body_outside_of_the_square_has_no_shadow() -> None:
    assert optical_depth((9.0, 0.0, 0.0)).max() == 0.0
