"""Shapes as points: where a model's geoms are, told without MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np

from beliefscope.datasets.readers.push_real_task import block_model
from beliefscope.datasets.simulation.door import DoorPhysics, door_model
from beliefscope.datasets.simulation.push import HEIGHT, RADIUS, push_model
from beliefscope.datasets.simulation.shapes import shapes


def test_every_shape_but_the_floor_is_there() -> None:
    model = door_model(DoorPhysics((0.8, -0.3), 0.6))
    found = shapes(model)
    assert len(found) == model.ngeom - 1
    assert {one.name for one in found} >= {"link0", "link7", "hand", "finger_left", "door", "frame"}
    for one in found:
        assert one.name == model.body(one.body).name
        assert one.rgba.shape == (4,)


def test_points_lie_on_the_surface() -> None:
    """By MuJoCo's own rays: one from outside, aimed just beneath a point, hits before it gets there."""
    model = push_model()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    hit = np.zeros(1, np.int32)
    for one in shapes(model):
        points = one.points @ data.xmat[one.body].reshape(3, 3).T + data.xpos[one.body]
        centre = points.mean(axis=0)
        for point in points[:: max(1, len(points) // 7)]:
            eye, within = centre + 3.0 * (point - centre), centre + 0.999 * (point - centre)
            distance = mujoco.mj_ray(model, data, eye, within - eye, None, 1, -1, hit, None)
            assert 0.0 <= distance <= 1.0


def test_a_cylinder_has_its_size() -> None:
    (puck,) = (one for one in shapes(push_model()) if one.name == "puck")
    half = np.array([RADIUS, RADIUS, HEIGHT / 2])
    np.testing.assert_allclose(puck.points.min(axis=0), -half, atol=1e-9)
    np.testing.assert_allclose(puck.points.max(axis=0), half, atol=1e-9)
    assert puck.faces is None


def test_capsules_end_in_half_balls() -> None:
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="rod")
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=(0.1, 0.0, 0.0, 0.5, 0.0, 0.0), size=(0.05, 0, 0))
    (rod,) = shapes(spec.compile())
    np.testing.assert_allclose(rod.points.min(axis=0), (0.05, -0.05, -0.05), atol=1e-9)
    np.testing.assert_allclose(rod.points.max(axis=0), (0.55, 0.05, 0.05), atol=1e-9)
    nearest = np.clip(rod.points[:, 0], 0.1, 0.5)
    off = np.linalg.norm(rod.points - np.stack([nearest, 0 * nearest, 0 * nearest], axis=1), axis=1)
    np.testing.assert_allclose(off, 0.05, atol=1e-9)


def test_a_mesh_keeps_its_faces() -> None:
    block = next(one for one in shapes(block_model("rect1")) if one.name == "block")
    assert block.faces is not None
    assert block.faces.max() < len(block.points)
    np.testing.assert_allclose(np.abs(block.points[:, :2]).max(axis=0), 0.045, atol=1e-6)
