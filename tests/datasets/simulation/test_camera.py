"""Camera: reproducible images that show the state."""

from __future__ import annotations

import hashlib
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from beliefscope.datasets.simulation.camera import Camera, Image, RayCaster
from beliefscope.datasets.simulation.door import CAMERA, door_model
from beliefscope.datasets.simulation.door_physics import DoorPhysics

pytestmark = pytest.mark.slow

SNAPSHOT = """
import hashlib, mujoco
from beliefscope.datasets.simulation.camera import RayCaster
from beliefscope.datasets.simulation.door import CAMERA, door_model
from beliefscope.datasets.simulation.door_physics import DoorPhysics
model = door_model(DoorPhysics((0.8, -0.3), 0.6))
data = mujoco.MjData(model)
mujoco.mj_kinematics(model, data)
print(hashlib.sha256(RayCaster(model, CAMERA).render(data).tobytes()).hexdigest())
"""


def render(hinge: tuple[float, float], angle: float) -> Image:
    model = door_model(DoorPhysics(hinge, 0.6))
    data = mujoco.MjData(model)
    data.joint("door").qpos[:] = angle
    mujoco.mj_kinematics(model, data)
    return RayCaster(model, CAMERA).render(data)


def test_image_size_type_and_contrast() -> None:
    image = render((0.81, -0.28), 0.6)
    assert image.shape == (32, 32)
    assert image.dtype == np.uint8
    assert np.ptp(image) > 120


def test_image_is_the_same_in_other_processes() -> None:
    command = [sys.executable, "-c", SNAPSHOT]
    digest = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout.strip()
    assert digest == hashlib.sha256(render((0.8, -0.3), 0.0).tobytes()).hexdigest()


def test_image_changes_with_the_angle_near_the_panel() -> None:
    change = np.abs(render((0.81, -0.28), 0.5).astype(int) - render((0.81, -0.28), 0.6))
    rows, _columns = np.nonzero(change > 10)
    assert len(rows) > 10
    assert rows.max() < 20, "only near the door, in the upper part of the image"
    assert np.abs(render((0.81, -0.28), 0.5).astype(int) - render((0.81, -0.28), 0.501)).sum() > 0


@pytest.mark.parametrize(("hinge", "shift"), [((0.81 + 0.075, -0.28), (-2, 0)), ((0.81, -0.28 - 0.075), (0, 2))])
def test_image_shifts_with_the_hinge(hinge: tuple[float, float], shift: tuple[int, int]) -> None:
    """Up is +x and left is +y; 7.5 cm are slightly more than two pixels at the top of the door."""
    moved, reference = render(hinge, 0.3)[:12].astype(int), render((0.81, -0.28), 0.3)[:12].astype(int)
    scores = {
        (dy, dx): np.abs(moved - np.roll(reference, (dy, dx), (0, 1)))[3:9, 4:28].sum()
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
    # The outermost rays are half a ray inside the field of view.
    assert np.arctan(top @ np.array(CAMERA.up) / -top[2]) == pytest.approx(CAMERA.field_of_view / 2, rel=0.03)


def test_shading_is_lambertian() -> None:
    """A plane has brightness colour x (ambient + (1 - ambient) cos); empty pixels show the background."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(5, 5, 0.1), rgba=(0.5, 0.5, 0.5, 1))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    down = Camera((0, 0, 1), (0, 0, -1), (1, 0, 0), 0.5, size=4)
    assert (RayCaster(model, down).render(data) == round(255 * 0.5 * (0.35 + 0.65 * 0.82))).all()
    up = Camera((0, 0, 1), (0, 0, 1), (1, 0, 0), 0.5, size=4)
    assert (RayCaster(model, up).render(data) == round(255 * 0.05)).all()


def test_moved_camera_turns_about_its_axes_and_shifts() -> None:
    camera = Camera((1.0, 2.0, 3.0), (1, 0, 0), (0, 0, 1), 0.5)
    moved = camera.moved((0.1, 0.0, -0.2), (0.0, 0.0, np.pi / 2))
    np.testing.assert_allclose(moved.position, (1.1, 2.0, 2.8))
    np.testing.assert_allclose([moved.forward, moved.up], [(0, 1, 0), (0, 0, 1)], atol=1e-12)
    still = camera.moved((0, 0, 0), (0, 0, 0))
    np.testing.assert_allclose(still.rays(), camera.rays())
