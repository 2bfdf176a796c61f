"""Soft shadow of the bodies on the floor, with the light straight above: it shows where the hand is over the floor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from beliefscope.inspect.figures.scene_shapes import Array, ColoredMesh

SAMPLES = 400  # points on the surfaces of all bodies
CELLS = 80  # per side
PENUMBRA = (0.025, 0.05)  # m: standard deviation of a point's shadow on the floor, and its growth for each m of height
DARKNESS = 0.25  # opacity below a closed surface
DENSITY = 1.5  # optical depth for each m^2 of surface and m^2 of floor


class FloorShadow:
    """Shadow of a model's bodies on a square of the floor.

    Points drawn uniformly on the surfaces, with a fixed seed, have Gaussian shadows, wider for higher points. Their sum
    is the optical depth, so that the opacity saturates where surfaces overlap.
    """

    def __init__(self, parts: Sequence[ColoredMesh], centre: tuple[float, float], side: float) -> None:
        """parts: at least one mesh, in the frames of their bodies. centre, side: of the square, m."""
        corners = [part.vertices[part.faces].astype(np.float64) for part in parts]  # (F, 3, 3) each
        bodies = np.concatenate([np.full(len(part.faces), part.body) for part in parts])
        a, b, c = np.concatenate(corners).transpose(1, 0, 2)
        areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        rng = np.random.default_rng(0)
        faces = rng.choice(len(areas), SAMPLES, p=areas / areas.sum())
        u, v = rng.random((2, SAMPLES, 1))
        u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
        self._points = a[faces] + u * (b - a)[faces] + v * (c - a)[faces]
        self._bodies = bodies[faces]
        self._area = areas.sum() / SAMPLES  # m^2 of each point
        ticks = ((np.arange(CELLS) + 0.5) / CELLS - 0.5) * side
        self._ticks = np.asarray(centre)[:, None] + ticks  # (2, CELLS), m
        self.side = side

    def opacity(self, positions: Array, rotations: Array) -> NDArray[np.floating]:
        """(y, x) opacity of the shadow at body positions (B, 3), m, and rotations (B, 3, 3), body to world."""
        rotated = np.einsum("nij,nj->ni", rotations[self._bodies], self._points)
        x, y, z = (rotated + positions[self._bodies]).T
        deviation = PENUMBRA[0] + PENUMBRA[1] * np.clip(z, 0.0, None)
        # The kernels of both axes, (CELLS, N) each: a Gaussian of two dimensions is their outer product.
        kernels = [
            np.exp(-0.5 * ((ticks[:, None] - centre) / deviation) ** 2) / (np.sqrt(2.0 * np.pi) * deviation)
            for ticks, centre in zip(self._ticks, (x, y), strict=True)
        ]
        depth = DENSITY * self._area * kernels[1] @ kernels[0].T
        return DARKNESS * (1.0 - np.exp(-depth))
