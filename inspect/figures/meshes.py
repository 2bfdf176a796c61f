"""Shapes as triangles, for whoever draws surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from beliefscope.datasets.simulation.shapes import Shape

Array = NDArray[np.float32]

EDGED = 64
"""Points below which a hull is shown with its edges, as a box or a cylinder has; others are round."""


@dataclass(frozen=True)
class Solid:
    """A surface in its body's frame.

    Attributes:
        vertices, normals: (V, 3) m, and unit vectors that point outwards. faces: (F, 3), seen from outside
            counter-clockwise. rgba: (4,) 0..1.
    """

    vertices: Array
    normals: Array
    faces: NDArray[np.int32]
    rgba: NDArray[np.float64]


def solid(shape: Shape) -> Solid:
    """The surface of a shape. Its normals are smooth over round shapes and meshes, those of the faces elsewhere."""
    vertices = shape.points
    faces = hull(vertices) if shape.faces is None else shape.faces
    if shape.faces is None and len(vertices) < EDGED:
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(faces.size, dtype=np.int32).reshape(-1, 3)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    across = np.cross(b - a, c - a)  # twice the face's area long: large faces count for more
    normals = np.zeros_like(vertices)
    for corner in faces.T:
        np.add.at(normals, corner, across)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return Solid(vertices.astype(np.float32), normals.astype(np.float32), faces.astype(np.int32), shape.rgba)


def hull(points: NDArray[np.float64]) -> NDArray[np.int32]:
    """(F, 3) faces of the convex hull of points (V, 3), counter-clockwise as seen from outside."""
    found = ConvexHull(points)
    a, b, c = np.moveaxis(points[found.simplices], 1, 0)
    inwards = (np.cross(b - a, c - a) * found.equations[:, :3]).sum(axis=1) < 0.0
    faces = np.where(inwards[:, None], found.simplices[:, ::-1], found.simplices)
    return faces.astype(np.int32)
