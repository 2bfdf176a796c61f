"""Robot and object in a recording: their shapes once, and where each body was at every step."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from typing import Any

import numpy as np
import rerun as rr

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation.replay import model_of, poses
from beliefscope.datasets.simulation.shapes import shapes
from beliefscope.datasets.task import Task
from beliefscope.inspect.figures.meshes import Solid, solid
from beliefscope.inspect.trace import Trace


class Bodies:
    """The bodies of a trace's replay that have a shape; none where it cannot be replayed."""

    def __init__(self, trace: Trace, task: Task) -> None:
        self._solids: dict[tuple[int, str], list[Solid]] = {}
        try:
            self._model = model_of(task, trace.episode)
        except BadInput:  # a recording of others may not say what its world was like
            self._model = None
        if self._model is not None:
            found = sorted(shapes(self._model), key=lambda one: one.body)
            for body, group in groupby(found, key=lambda one: (one.body, one.name)):
                self._solids[body] = [solid(shape) for shape in group]

    def looks(self) -> Iterator[tuple[str, rr.Mesh3D]]:
        """The shape of each, which does not change."""
        for (_, name), parts in self._solids.items():
            first = np.cumsum([0, *(len(part.vertices) for part in parts)])
            yield (
                f"world/bodies/{name}",
                rr.Mesh3D(
                    vertex_positions=np.concatenate([part.vertices for part in parts]),
                    vertex_normals=np.concatenate([part.normals for part in parts]),
                    vertex_colors=np.concatenate([np.tile(_rgba(part), (len(part.vertices), 1)) for part in parts]),
                    triangle_indices=np.concatenate([part.faces + at for part, at in zip(parts, first, strict=False)]),
                ),
            )

    def columns(self, qpos: np.ndarray) -> Iterator[tuple[str, Any]]:
        """Where each was at some steps, by their joint positions (T, nq)."""
        if self._model is None:
            return
        positions, rotations = poses(self._model, qpos)
        for body, name in self._solids:
            at, turned = positions[:, body], rotations[:, body]
            yield f"world/bodies/{name}", rr.Transform3D.columns(translation=at, mat3x3=turned)


def _rgba(part: Solid) -> np.ndarray:
    return np.rint(255.0 * part.rgba).astype(np.uint8)
