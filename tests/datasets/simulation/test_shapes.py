"""Geometry of MuJoCo models as points."""

from __future__ import annotations

import mujoco
import numpy as np

from beliefscope.datasets.readers.push_real_task import block_model
from beliefscope.datasets.simulation.door import door_model
from beliefscope.datasets.simulation.door_physics import DoorPhysics
from beliefscope.datasets.simulation.push import HEIGHT, RADIUS, push_model
from beliefscope.datasets.simulation.shapes import shapes


def test_all_shapes_except_the_floor() -> None:
    model = door_model(DoorPhysics((0.8, -0.3), 0.6))
    result = shapes(model)
    assert len(result) == model.ngeom - 1
    assert {shape.name for shape in result} >= {"link0", "link7", "hand", "finger_left", "door", "frame"}
    for shape in result:
        assert shape.name == model.body(shape.body).name
        assert shape.rgba.shape == (4,)


def test_points_lie_on_the_surface() -> None:
    """A MuJoCo ray from outside to a position just below a point hits the surface before it arrives."""
    model = push_model()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    hit = np.zeros(1, np.int32)
    for shape in shapes(model):
        points = shape.points @ data.xmat[shape.body].reshape(3, 3).T + data.xpos[shape.body]
        centre = points.mean(axis=0)
        for point in points[:: max(1, len(points) // 7)]:
            eye, within = centre + 3.0 * (point - centre), centre + 0.999 * (point - centre)
            distance = mujoco.mj_ray(model, data, eye, within - eye, None, 1, -1, hit, None)
            assert 0.0 <= distance <= 1.0


def test_cylinder_size() -> None:
    (puck,) = (shape for shape in shapes(push_model()) if shape.name == "puck")
    half = np.array([RADIUS, RADIUS, HEIGHT / 2])
    np.testing.assert_allclose(puck.points.min(axis=0), -half, atol=1e-9)
    np.testing.assert_allclose(puck.points.max(axis=0), half, atol=1e-9)
    assert puck.faces is None


def test_capsule_has_hemispherical_ends() -> None:
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="rod")
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=(0.1, 0.0, 0.0, 0.5, 0.0, 0.0), size=(0.05, 0, 0))
    (rod,) = shapes(spec.compile())
    np.testing.assert_allclose(rod.points.min(axis=0), (0.05, -0.05, -0.05), atol=1e-9)
    np.testing.assert_allclose(rod.points.max(axis=0), (0.55, 0.05, 0.05), atol=1e-9)
    nearest = np.clip(rod.points[:, 0], 0.1, 0.5)
    distance = np.linalg.norm(rod.points - np.stack([nearest, 0 * nearest, 0 * nearest], axis=1), axis=1)
    np.testing.assert_allclose(distance, 0.05, atol=1e-9)


def test_mesh_has_faces() -> None:
    block = next(shape for shape in shapes(block_model("rect1")) if shape.name == "block")
    assert block.faces is not None
    assert block.faces.max() < len(block.points)
    np.testing.assert_allclose(np.abs(block.points[:, :2]).max(axis=0), 0.045, atol=1e-6)
