"""Estimate of the comparison run in the 3D scene, with a dashed outline."""

from __future__ import annotations

from typing import Any

import numpy as np
from viser import ViserServer

from beliefscope.app.views.scene_belief import BELIEF_HEIGHT, OUTLINE_EDGES, POLE_RADIUS
from beliefscope.app.views.scene_context import SMALL_LABEL, UP, Array, rgb
from beliefscope.datasets.task import Task
from beliefscope.inspect.trace import Trace

DASHES = 5  # per edge, with gaps of the same length
SHORT_EDGE = 0.03  # m: of shorter edges, every second one is drawn without gaps


class ComparisonEstimate:
    """Scene nodes of the comparison run's fused estimate."""

    def __init__(self, server: ViserServer, task: Task, trace: Trace) -> None:
        scene, color = server.scene, rgb("fused", trace)
        states = trace.estimate_mean
        self._outline = None if task.outline is None else task.outline(states)
        flat = np.column_stack([states[:, list(task.map_indices)], np.zeros(len(states))])
        self._anchors = flat if self._outline is None else self._outline.anchor
        # Ends below the labels of the selected run.
        self._height = float(self._anchors[0, 2]) + (0.0 if self._outline is None else BELIEF_HEIGHT)
        self._root = scene.add_frame("/other", show_axes=False)
        self._pole: Any = scene.add_cylinder(
            "/other/pole", POLE_RADIUS / 2, self._height, color=color, cast_shadow=False
        )
        self._label: Any = scene.add_label("/other/label", "comparison run", anchor="bottom-center", **SMALL_LABEL)
        self._frame: Any = None
        if self._outline is not None:
            self._frame = scene.add_frame("/other/outline", show_axes=False)
            edges = dashed(OUTLINE_EDGES[self._outline.shape] * (np.asarray(self._outline.size) + 0.008))
            scene.add_line_segments(
                "/other/outline/edges", edges.astype(np.float32), color, thickness=2.0, thickness_units="screen"
            )

    def move(self, step: int) -> None:
        """Move all nodes to their poses at a step."""
        foot = np.array([*self._anchors[step, :2], 0.0])
        self._pole.position = foot + self._height / 2.0 * UP
        self._label.position = foot + self._height * UP
        if self._outline is not None:
            self._frame.position, self._frame.wxyz = self._outline.position[step], self._outline.wxyz[step]

    def remove(self) -> None:
        """Remove all nodes from the scene."""
        self._root.remove()


def dashed(edges: Array) -> Array:
    """Edges (E, 2, 3) in m as dashes (D, 2, 3)."""
    start, along = edges[:, :1], edges[:, 1:] - edges[:, :1]
    short = np.linalg.norm(along[:, 0], axis=-1) < SHORT_EDGE
    fractions = (np.arange(2 * DASHES) / (2 * DASHES - 1)).reshape(1, DASHES, 2, 1)
    dashes = start[~short, None] + fractions * along[~short, None]
    return np.concatenate([dashes.reshape(-1, 2, 3), edges[short][::2]])
