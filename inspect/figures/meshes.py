"""Triangle meshes of shapes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from beliefscope.datasets.simulation.shapes import Shape

Array = NDArray[np.float32]

MAX_FLAT_POINTS = 64
"""Number of points below which a convex hull is drawn with flat faces, such as a box; otherwise it is smooth."""


@dataclass(frozen=True)
class Mesh:
    """Surface in the frame of its body.

    Attributes:
        vertices: (V, 3) m.
        normals: (V, 3) outward unit normals.
        faces: (F, 3) vertex indices, counter-clockwise seen from the exterior.
        rgba: (4,) 0..1.
    """

    vertices: Array
    normals: Array
    faces: NDArray[np.int32]
    rgba: NDArray[np.float64]


def mesh_of(shape: Shape) -> Mesh:
    """Mesh of a shape, with smooth normals for round shapes and meshes and face normals otherwise."""
    vertices = shape.points
    faces = hull_faces(vertices) if shape.faces is None else shape.faces
    if shape.faces is None and len(vertices) < MAX_FLAT_POINTS:
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(faces.size, dtype=np.int32).reshape(-1, 3)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    weighted = np.cross(b - a, c - a)  # face normal times twice the area
    normals = np.zeros_like(vertices)
    for corner in faces.T:
        np.add.at(normals, corner, weighted)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return Mesh(vertices.astype(np.float32), normals.astype(np.float32), faces.astype(np.int32), shape.rgba)


def hull_faces(points: NDArray[np.float64]) -> NDArray[np.int32]:
    """(F, 3) faces of the convex hull of points (V, 3), counter-clockwise seen from the exterior."""
    hull = ConvexHull(points)
    a, b, c = np.moveaxis(points[hull.simplices], 1, 0)
    inwards = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(axis=1) < 0.0
    faces = np.where(inwards[:, None], hull.simplices[:, ::-1], hull.simplices)
    return faces.astype(np.int32)
