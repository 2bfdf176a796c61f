"""Appearance of the Panda: closed surfaces that change neither the dynamics nor what the camera sees."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest

from beliefscope.datasets.simulation.door import door_model
from beliefscope.datasets.simulation.door_physics import DoorPhysics
from beliefscope.datasets.simulation.panda_visual import HIDDEN_GROUP, VISUAL_GROUP, housing
from beliefscope.datasets.simulation.push import push_model
from beliefscope.datasets.simulation.shapes import shapes

PHYSICS = DoorPhysics((0.8, -0.3), 0.6)


@pytest.mark.parametrize("end", [(0.1, 0.2, 0.45), (0.4, 0.1, 0.25), (0.1, 0.2, -0.3)])
def test_housings_are_closed_with_outward_faces(end: tuple[float, float, float]) -> None:
    start = np.array([0.1, 0.2, 0.3])
    vertices, faces = housing(start, np.array(end), 0.05, 0.04, np.linspace(0.0, np.pi / 2, 4))
    edges = Counter((int(a), int(b)) for face in faces for a, b in zip(face, np.roll(face, -1), strict=True))
    assert set(edges.values()) == {1}
    assert all((b, a) in edges for a, b in edges)
    corners = vertices[faces] - vertices.mean(0)
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    length = np.linalg.norm(np.array(end) - start)
    cone = np.pi * length * (0.05**2 + 0.05 * 0.04 + 0.04**2) / 3.0
    assert 0.8 * cone < volume < cone  # an inscribed polygon with rounded edges
    along = (vertices - start) @ (np.array(end) - start) / length
    assert along.min() == pytest.approx(0.0, abs=1e-12)
    assert along.max() == pytest.approx(length)


@pytest.mark.parametrize("build", [lambda visual: door_model(PHYSICS, visual), push_model])
def test_the_appearance_changes_nothing_else(build: Callable[[bool], Any]) -> None:
    plain, displayed = build(False), build(True)
    added = displayed.geom_group == VISUAL_GROUP
    assert not (plain.geom_group == VISUAL_GROUP).any()
    assert displayed.ngeom - added.sum() == plain.ngeom
    assert not displayed.geom_contype[added].any()
    assert not displayed.geom_conaffinity[added].any()
    links = {displayed.body(b).name for b in displayed.geom_bodyid[added]}
    assert links == {f"link{i}" for i in range(8)}
    hidden = displayed.geom_group == HIDDEN_GROUP
    assert {displayed.body(b).name for b in displayed.geom_bodyid[hidden]} == links
    for quantity in ("body_mass", "body_inertia", "body_ipos", "body_pos", "body_quat", "jnt_range"):
        np.testing.assert_array_equal(getattr(displayed, quantity), getattr(plain, quantity))
    for before, after in zip(shapes(plain, visual=False), shapes(displayed, visual=False), strict=True):
        np.testing.assert_array_equal(before.points, after.points)
    assert any(shape.faces is not None for shape in shapes(displayed))
    data = [mujoco.MjData(model) for model in (plain, displayed)]
    for model, state in zip((plain, displayed), data, strict=True):
        mujoco.mj_step(model, state, 50)
    np.testing.assert_array_equal(data[0].qpos, data[1].qpos)
