"""Shadows on the floor: their form, and that height spreads them without adding any."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from beliefscope.inspect.figures.scene_shapes import ColoredMesh
from beliefscope.inspect.figures.soft_shadows import SHADOW_EDGE, SHADOW_OPACITY, SoftShadows

HALF_SIZE = np.array([0.3, 0.1, 0.05])
HALF_WIDTH = 1.0
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * HALF_SIZE


def shadow(position: tuple[float, float, float], yaw: float = 0.0, body: int = 1) -> NDArray[np.float64]:
    """Opacity of the shadow of a box at a position and yaw."""
    mesh = ColoredMesh(body, (0, 0, 0), 1.0, CORNERS, np.zeros((0, 3), int))
    cos, sin = np.cos(yaw), np.sin(yaw)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    positions, rotations = np.zeros((2, 3)), np.stack([np.eye(3)] * 2)
    positions[body], rotations[body] = position, turn
    return SoftShadows([mesh], (0.0, 0.0), HALF_WIDTH).opacity(positions, rotations)


def test_the_area_of_a_shadow_is_that_of_the_body_and_a_narrow_edge() -> None:
    image = shadow((0.0, 0.0, 0.0))
    side = HALF_WIDTH * (np.arange(0.5, len(image)) * 2.0 / len(image) - 1.0)
    y, x = np.nonzero(image)
    pixel = side[1] - side[0]
    assert abs(side[x]).max() == pytest.approx(HALF_SIZE[0] + SHADOW_EDGE, abs=pixel)
    assert abs(side[y]).max() == pytest.approx(HALF_SIZE[1] + SHADOW_EDGE, abs=pixel)
    assert 0.5 * SHADOW_OPACITY < image.max() <= SHADOW_OPACITY


@pytest.mark.parametrize("height", [0.1, 0.5, 1.0])
def test_raising_a_body_spreads_its_shadow_and_adds_none(height: float) -> None:
    low, high = shadow((0.0, 0.0, 0.0)), shadow((0.0, 0.0, height))
    assert (high > 0).sum() > (low > 0).sum()
    assert high.max() < low.max()
    # Both are paraboloids over an ellipse, of volume pi / 2 * half size x * half size y * opacity; pixels of 2 cm.
    assert high.sum() == pytest.approx(low.sum(), rel=0.01)


def test_a_shadow_turns_and_moves_with_its_body() -> None:
    # A quarter turn exchanges the axes; 0.2 m are ten pixels. The tolerance is the rounding of the eigenvectors.
    np.testing.assert_allclose(shadow((0.0, 0.0, 0.2), yaw=np.pi / 2), shadow((0.0, 0.0, 0.2)).T, atol=1e-9)
    np.testing.assert_allclose(shadow((0.2, 0.0, 0.2)), np.roll(shadow((0.0, 0.0, 0.2)), 10, axis=1), atol=1e-9)


def test_the_world_casts_no_shadow() -> None:
    assert not shadow((0.0, 0.0, 0.0), body=0).any()
