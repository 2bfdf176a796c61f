"""Geometry of a MuJoCo model as points, for drawing it in figures and recordings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.simulation.panda_visual import HIDDEN_GROUP, VISUAL_GROUP

Array = NDArray[np.float64]

_TURN = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
_RIM = np.stack([np.cos(_TURN), np.sin(_TURN), np.zeros(24)], axis=1)
_SLOPES = np.linspace(-np.pi / 2, np.pi / 2, 13)
_BALL = np.concatenate([np.cos(slope) * _RIM + [0.0, 0.0, np.sin(slope)] for slope in _SLOPES[1:-1]])
_BALL = np.concatenate([_BALL, [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]])
_BOX = np.array([[bit >> axis & 1 for axis in range(3)] for bit in range(8)]) * 2.0 - 1.0
_UP = np.array([0.0, 0.0, 1.0])
_TERRAIN = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)


@dataclass(frozen=True)
class Shape:
    """A geom of a model.

    Attributes:
        body: index of its body. name: name of its body.
        points: (V, 3) m, in the body's frame. faces: (F, 3) of a mesh; None: convex hull of the points.
        rgba: (4,) 0..1.
    """

    body: int
    name: str
    points: Array
    faces: NDArray[np.int32] | None
    rgba: Array


def shapes(model: Any, visual: bool = True) -> list[Shape]:
    """All shapes of a model (``mujoco.MjModel``) except planes and height fields.

    Args:
        visual: return the displayed shapes; otherwise the shapes in the task's camera images.
    """
    result = []
    for geom in range(model.ngeom):
        kind, body = int(model.geom_type[geom]), int(model.geom_bodyid[geom])
        hidden = model.geom_group[geom] >= HIDDEN_GROUP
        displayed_only = model.geom_group[geom] == VISUAL_GROUP
        if kind in _TERRAIN or (hidden if visual else displayed_only):
            continue
        points, faces = _points(model, geom, kind)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
        placed = points @ turn.reshape(3, 3).T + model.geom_pos[geom]
        result.append(Shape(body, model.body(body).name, placed, faces, model.geom_rgba[geom].astype(float)))
    return result


def _points(model: Any, geom: int, kind: int) -> tuple[Array, NDArray[np.int32] | None]:
    """Points in the geom's frame, and the faces of a mesh."""
    size, types = model.geom_size[geom].astype(float), mujoco.mjtGeom
    if kind == types.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        return model.mesh_vert[first : first + count].astype(float), model.mesh_face[face : face + faces].copy()
    if kind == types.mjGEOM_BOX:
        return _BOX * size, None
    if kind == types.mjGEOM_SPHERE:
        return _BALL * size[0], None
    if kind == types.mjGEOM_ELLIPSOID:
        return _BALL * size, None
    end = size[0] * (_RIM if kind == types.mjGEOM_CYLINDER else _BALL[_BALL[:, 2] >= 0.0]) + size[1] * _UP
    return np.concatenate([end, -end]), None


def object_bodies(model: Any) -> NDArray[np.bool_]:
    """(B,) bodies of a ``mujoco.MjModel`` that belong neither to the robot nor to the world."""
    return ~_robot_bodies(model) & (np.arange(model.nbody) > 0)


def hand_bodies(model: Any) -> NDArray[np.bool_]:
    """(B,) end of a robot: bodies without children, such as fingers, and bodies with only such children."""
    children = np.bincount(model.body_parentid[1:], minlength=model.nbody)
    leaves = _robot_bodies(model) & (children == 0)
    leaf_children = np.bincount(model.body_parentid[leaves], minlength=model.nbody)
    return leaves | (_robot_bodies(model) & (leaf_children > 0) & (leaf_children == children))


def _robot_bodies(model: Any) -> NDArray[np.bool_]:
    """(B,) the kinematic tree with the most joints."""
    joints = np.bincount(model.body_rootid[model.jnt_bodyid], minlength=model.nbody)
    bodies: NDArray[np.bool_] = model.body_rootid == joints.argmax()
    return bodies
