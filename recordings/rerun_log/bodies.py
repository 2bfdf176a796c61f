"""Robot and object in a recording: shapes (static), and the pose of each body at every step."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from typing import Any

import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.replay import body_poses, replay_model
from beliefscope.datasets.simulation.shapes import shapes
from beliefscope.datasets.task import Task
from beliefscope.inspect.figures.meshes import Mesh, mesh_of
from beliefscope.inspect.trace import Trace


class Bodies:
    """Bodies with a shape in the replay of a trace; none if it cannot be replayed."""

    def __init__(self, trace: Trace, task: Task) -> None:
        self._solids: dict[tuple[int, str], list[Mesh]] = {}
        try:
            self._model = replay_model(task, trace.episode)
        except BadInput:  # external data may lack the parameters of the simulation
            self._model = None
        if self._model is not None:
            by_body = sorted(shapes(self._model), key=lambda shape: shape.body)
            for body, group in groupby(by_body, key=lambda shape: (shape.body, shape.name)):
                self._solids[body] = [mesh_of(shape) for shape in group]

    def static(self) -> Iterator[tuple[str, Any]]:
        """Path and mesh of each body, and the poses of fixed ones."""
        for (body, name), parts in self._solids.items():
            offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
            yield (
                f"world/bodies/{name}",
                rr.Mesh3D(
                    vertex_positions=np.concatenate([part.vertices for part in parts]),
                    vertex_normals=np.concatenate([part.normals for part in parts]),
                    vertex_colors=np.concatenate([np.tile(_rgba(part), (len(part.vertices), 1)) for part in parts]),
                    triangle_indices=np.concatenate(
                        [part.faces + offset for part, offset in zip(parts, offsets, strict=False)]
                    ),
                ),
            )
            if not self._moves(body):
                positions, rotations = body_poses(self._model, np.zeros((1, self._model.nq)))
                pose = rr.Transform3D(translation=positions[0, body], mat3x3=rotations[0, body])
                yield f"world/bodies/{name}", pose

    def columns(self, qpos: np.ndarray) -> Iterator[tuple[str, Any]]:
        """Poses of the moving bodies at joint positions (T, nq)."""
        if self._model is None:
            return
        positions, rotations = body_poses(self._model, qpos)
        for body, name in self._solids:
            if self._moves(body):
                quaternions = Rotation.from_matrix(rotations[:, body]).as_quat()  # x, y, z, w, as in Rerun
                transforms = rr.Transform3D.columns(translation=positions[:, body], quaternion=quaternions)
                yield f"world/bodies/{name}", transforms

    def _moves(self, body: int) -> bool:
        assert self._model is not None
        return bool(self._model.body_weldid[body] != 0)


def _rgba(part: Mesh) -> np.ndarray:
    return np.rint(255.0 * part.rgba).astype(np.uint8)
