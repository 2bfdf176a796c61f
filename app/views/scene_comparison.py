"""The other run in the 3D scene: where its estimate is, dashed beside this one's."""

from __future__ import annotations

from typing import Any

import numpy as np
from viser import ViserServer

from beliefscope.app.views.scene_belief import BELIEF_ABOVE, OUTLINES, POLE_RADIUS
from beliefscope.app.views.scene_context import SMALL, UP, Array, rgb
from beliefscope.datasets.task import Task
from beliefscope.inspect.trace import Trace

DASHES = 5  # along an edge, with gaps as long as they are
SHORT = 0.03  # m: of edges that short every other one is drawn, whole


class Shadow:
    """The nodes of the other run's fused estimate in viser's scene, and where they are at each step."""

    def __init__(self, server: ViserServer, task: Task, trace: Trace) -> None:
        scene, hue = server.scene, rgb("fused", trace)
        states = trace.estimate_mean
        self._ghost = None if task.ghost is None else task.ghost(states)
        flat = np.column_stack([states[:, list(task.map_indices)], np.zeros(len(states))])
        self._anchors = flat if self._ghost is None else self._ghost.anchor
        above = 0.0 if self._ghost is None else BELIEF_ABOVE
        self._height = float(self._anchors[0, 2]) + above  # below the labels of this run
        self._root = scene.add_frame("/other", show_axes=False)
        self._pole: Any = scene.add_cylinder("/other/pole", POLE_RADIUS / 2, self._height, color=hue, cast_shadow=False)
        self._label: Any = scene.add_label("/other/label", "other run", anchor="bottom-center", **SMALL)
        self._outline: Any = None
        if self._ghost is not None:
            self._outline = scene.add_frame("/other/ghost", show_axes=False)
            edges = dashed(OUTLINES[self._ghost.shape] * (np.asarray(self._ghost.size) + 0.008))
            scene.add_line_segments(
                "/other/ghost/edges", edges.astype(np.float32), hue, thickness=2.0, thickness_units="screen"
            )

    def move(self, step: int) -> None:
        """Put every node where it belongs at a step."""
        foot = np.array([*self._anchors[step, :2], 0.0])
        self._pole.position = foot + self._height / 2.0 * UP
        self._label.position = foot + self._height * UP
        if self._ghost is not None:
            self._outline.position, self._outline.wxyz = self._ghost.position[step], self._ghost.wxyz[step]

    def remove(self) -> None:
        """Take them out of the scene."""
        self._root.remove()


def dashed(edges: Array) -> Array:
    """Edges (E, 2, 3) in m as dashes (D, 2, 3)."""
    start, along = edges[:, :1], edges[:, 1:] - edges[:, :1]
    short = np.linalg.norm(along[:, 0], axis=-1) < SHORT
    at = (np.arange(2 * DASHES) / (2 * DASHES - 1)).reshape(1, DASHES, 2, 1)
    pieces = start[~short, None] + at * along[~short, None]
    return np.concatenate([pieces.reshape(-1, 2, 3), edges[short][::2]])
