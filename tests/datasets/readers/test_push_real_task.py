"""Geometry of the block of the MIT Push tasks: outline, gap, model and images."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from beliefscope.datasets.readers.push_real_task import (
    CAMERA,
    CENTRE,
    OUTLINES,
    TIP_RADIUS,
    VIEW,
    block_model,
    gap,
    render_images,
)


def test_gap_of_a_square() -> None:
    poses = np.zeros((4, 3))
    poses[1, 2] = np.pi / 4
    poses[3, :2] = 0.2
    tips = np.array([(0.06, 0.01), (0.0, 0.07), (0.05, 0.05), (0.2, 0.2)])
    expected = np.array([0.015, 0.07 - 0.045 * np.sqrt(2), 0.005 * np.sqrt(2), -0.045]) - TIP_RADIUS
    np.testing.assert_allclose(gap("rect1", poses, tips), expected, atol=1e-12)


@pytest.mark.parametrize("shape", OUTLINES)
def test_image_shows_the_outline(shape: str) -> None:
    """Pixels differ from the table exactly where the block's outline covers them."""
    pose = np.array([0.36, -0.02, 0.7])
    image = render_images(shape, np.array([[*pose, 0.9, 0.9]]))[0]
    pixel = 2 * VIEW / CAMERA.size
    ticks = VIEW - pixel * (np.arange(CAMERA.size) + 0.5)
    x, y = np.meshgrid(CENTRE[0] + ticks, CENTRE[1] + ticks, indexing="ij")
    away = gap(shape, np.tile(pose, (x.size, 1)), np.column_stack([x.ravel(), y.ravel()])).reshape(x.shape) + TIP_RADIUS
    table = image[0, 0]
    assert (image[away < -0.75 * pixel] != table).all()
    assert (image[away > 1.0 * pixel] == table).all()


def test_block_model_matches_the_outline() -> None:
    model = block_model("rect3")
    data = mujoco.MjData(model)
    data.qpos[:] = [0.3, 0.1, np.pi / 2, 0.9, 0.9]
    mujoco.mj_forward(model, data)
    geom = model.geom("block").id
    hit = np.zeros(1, np.int32)
    for point, expected in (((0.3 + 0.044, 0.1), True), ((0.3 + 0.046, 0.1), False), ((0.3, 0.1 + 0.067), True)):
        mujoco.mj_ray(model, data, np.array([*point, 1.0]), np.array([0, 0, -1.0]), None, 1, -1, hit)
        assert (hit[0] == geom) == expected
