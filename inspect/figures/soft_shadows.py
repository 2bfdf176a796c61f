"""Soft shadows of bodies on the floor of a 3D scene."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.inspect.figures.scene_shapes import ColoredMesh

Array = NDArray[Any]

SHADOW_OPACITY = 0.7  # below the middle of a body that rests on the floor
SHADOW_EDGE = 0.02  # m, blur of a shadow at height 0
SHADOW_SPREAD = 0.2  # blur per height above the floor
SHADOW_PIXELS = 100  # per side of the image


class SoftShadows:
    """Shadows of a model's bodies on the floor, under a large light overhead, as an image.

    The bounding box of a body casts an ellipse. Its edge blurs in proportion to the height, and it fades as its area
    grows, so that raising a body spreads its shadow and adds none.
    """

    def __init__(self, meshes: list[ColoredMesh], centre: tuple[float, float], half_width: float) -> None:
        """meshes: of ``body_meshes``; the world's own shapes cast no shadow. centre, half_width: of the image, m."""
        corners: dict[int, list[Array]] = {}
        for part in meshes:
            if part.body:
                corners.setdefault(part.body, []).extend((part.vertices.min(axis=0), part.vertices.max(axis=0)))
        self._bodies = list(corners)
        low = np.array([np.min(points, axis=0) for points in corners.values()]).reshape(-1, 3)
        high = np.array([np.max(points, axis=0) for points in corners.values()]).reshape(-1, 3)
        self._centres, self._half_sizes = (low + high) / 2.0, (high - low) / 2.0  # (B, 3) m, in the body's frame
        side = half_width * (np.arange(0.5, SHADOW_PIXELS) / SHADOW_PIXELS * 2.0 - 1.0)
        self._x, self._y = centre[0] + side, centre[1] + side

    def opacity(self, positions: Array, rotations: Array) -> Array:
        """One step of ``Replay`` -> (P, P) opacity of the shadows, 0..1; row 0 has the smallest y."""
        rotations = rotations[self._bodies]
        centres = positions[self._bodies] + np.einsum("bij,bj->bi", rotations, self._centres)
        # A box projects into the ellipse of this matrix, whose semi-axes are the half sizes if it is level.
        matrix = (rotations[:, :2] * self._half_sizes[:, None] ** 2) @ rotations[:, :2].swapaxes(1, 2)
        squares, axes = np.linalg.eigh(matrix)
        semi_axes = np.sqrt(squares.clip(0.0))
        blurred = semi_axes + SHADOW_EDGE + SHADOW_SPREAD * centres[:, 2:].clip(0.0)
        strength = SHADOW_OPACITY * (semi_axes / blurred).prod(axis=-1)
        form = (axes / blurred[:, None] ** 2) @ axes.swapaxes(1, 2)  # 1 on the rim of the blurred ellipse
        xx, xy, yy = (form[:, i, j, None, None] for i, j in ((0, 0), (0, 1), (1, 1)))
        x = (self._x - centres[:, :1])[:, None]
        y = (self._y - centres[:, 1:2])[:, :, None]
        distance = xx * x**2 + (2.0 * xy * x + yy * y) * y
        shadows = strength[:, None, None] * (1.0 - distance).clip(0.0)
        return np.asarray(1.0 - (1.0 - shadows).prod(axis=0))
