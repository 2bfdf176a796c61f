"""The camera: the same picture always, and one that shows what is to be estimated."""

from __future__ import annotations

import subprocess
import sys

import mujoco
import numpy as np
import pytest

from beliefscope.datasets.simulation.camera import Camera, Picture, RayCaster
from beliefscope.datasets.simulation.door import CAMERA, DoorPhysics, door_model

SNAPSHOT = """
import hashlib, mujoco
from beliefscope.datasets.simulation.camera import RayCaster
from beliefscope.datasets.simulation.door import CAMERA, DoorPhysics, door_model
model = door_model(DoorPhysics((0.8, -0.3), 0.6))
data = mujoco.MjData(model)
mujoco.mj_kinematics(model, data)
print(hashlib.sha256(RayCaster(model, CAMERA).picture(data).tobytes()).hexdigest())
"""


def take(hinge: tuple[float, float], angle: float) -> Picture:
    model = door_model(DoorPhysics(hinge, 0.6))
    data = mujoco.MjData(model)
    data.joint("door").qpos[:] = angle
    mujoco.mj_kinematics(model, data)
    return RayCaster(model, CAMERA).picture(data)


def test_picture_is_a_gray_32_by_32_with_contrast() -> None:
    picture = take((0.81, -0.28), 0.6)
    assert picture.shape == (32, 32)
    assert picture.dtype == np.uint8
    assert np.ptp(picture) > 120


def test_same_picture_in_another_process() -> None:
    runs = [
        subprocess.run([sys.executable, "-c", SNAPSHOT], capture_output=True, text=True, check=True, timeout=60).stdout
        for _ in range(2)
    ]
    assert runs[0] == runs[1]
    assert len(runs[0].strip()) == 64


def test_picture_answers_the_angle_where_the_panel_is() -> None:
    change = np.abs(take((0.81, -0.28), 0.5).astype(int) - take((0.81, -0.28), 0.6))
    rows, _columns = np.nonzero(change > 10)
    assert len(rows) > 10
    assert rows.max() < 20, "only around the door, in the upper part of the picture"
    assert np.abs(take((0.81, -0.28), 0.5).astype(int) - take((0.81, -0.28), 0.501)).sum() > 0


@pytest.mark.parametrize(("hinge", "shift"), [((0.81 + 0.075, -0.28), (-2, 0)), ((0.81, -0.28 - 0.075), (0, 2))])
def test_picture_moves_with_the_hinge(hinge: tuple[float, float], shift: tuple[int, int]) -> None:
    """Up in the picture is +x and left is +y; 7.5 cm are a little over two pixels at the height of the door's top."""
    there, here = take(hinge, 0.3)[:12].astype(int), take((0.81, -0.28), 0.3)[:12].astype(int)
    scores = {
        (dy, dx): np.abs(there - np.roll(here, (dy, dx), (0, 1)))[3:9, 4:28].sum()
        for dy in range(-3, 4)
        for dx in range(-3, 4)
    }
    best = min(scores, key=lambda key: scores[key])
    assert np.abs(np.array(best) - shift).max() <= 1
    assert np.abs(best).max() >= 1


def test_rays_are_unit_vectors_around_the_axis() -> None:
    rays = CAMERA.rays()
    assert rays.shape == (64 * 64, 3)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1)
    mean = rays.mean(0)
    np.testing.assert_allclose(mean / np.linalg.norm(mean), CAMERA.forward, atol=1e-9)
    top = rays[:64].mean(0)
    assert top @ np.array(CAMERA.up) > 0
    # Outermost rays lie half a ray within the field of view.
    assert np.arctan(top @ np.array(CAMERA.up) / -top[2]) == pytest.approx(CAMERA.field_of_view / 2, rel=0.03)


def test_shading_is_lamberts() -> None:
    """A lit plane seen from above is gray by colour x (ambient + (1 - ambient) cos); nothing there is background."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(5, 5, 0.1), rgba=(0.5, 0.5, 0.5, 1))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    down = Camera((0, 0, 1), (0, 0, -1), (1, 0, 0), 0.5, size=4)
    assert (RayCaster(model, down).picture(data) == round(255 * 0.5 * (0.35 + 0.65 * 0.82))).all()
    up = Camera((0, 0, 1), (0, 0, 1), (1, 0, 0), 0.5, size=4)
    assert (RayCaster(model, up).picture(data) == round(255 * 0.05)).all()
