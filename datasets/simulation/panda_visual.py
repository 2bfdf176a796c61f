"""Appearance of the Panda in replays: installed meshes, or rounded, tapered housings with dark seams at the joints.

The camera never sees it, and nothing collides with it.
"""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.simulation.panda_meshes import Surface, link_surfaces, mesh_folder

HIDDEN_GROUP = 3
"""Geoms of this group and above are not drawn by MuJoCo's viewers and the page."""
VISUAL_GROUP = 2
"""Geoms that only serve the appearance."""

_WHITE, _DARK = (0.93, 0.94, 0.95, 1.0), (0.23, 0.25, 0.28, 1.0)
_TURN = np.linspace(0.0, 2.0 * np.pi, 18, endpoint=False)
_FILLETS = {False: np.linspace(0.0, np.pi / 2, 4), True: np.linspace(0.0, np.pi / 2, 2)}

Point = tuple[float, float, float]
Housing = tuple[Point, Point, float, float, bool]

# Housings of each link: from, to (m, in the link's frame, along the axis), radius at both ends, m; dark or white.
_HOUSINGS: tuple[tuple[Housing, ...], ...] = (
    (
        ((0, 0, 0), (0, 0, 0.14), 0.085, 0.07, False),
        ((-0.15, 0, 0.035), (0, 0, 0.05), 0.035, 0.065, False),
        ((0, 0, 0.135), (0, 0, 0.15), 0.066, 0.066, True),
    ),
    (
        ((0, 0, -0.185), (0, 0, 0.0), 0.068, 0.06, False),
        ((0, -0.075, 0), (0, 0.075, 0), 0.066, 0.066, False),
        ((0, -0.082, 0), (0, 0.082, 0), 0.052, 0.052, True),
    ),
    (
        ((0, 0, 0), (0, -0.185, 0), 0.058, 0.066, False),
        ((0, -0.18, 0), (0, -0.195, 0), 0.06, 0.06, True),
    ),
    (
        ((0, 0, -0.12), (0.01, 0, -0.04), 0.066, 0.062, False),
        ((0, 0, -0.05), (0.0825, 0, 0), 0.062, 0.058, False),
        ((0.0825, -0.07, 0), (0.0825, 0.07, 0), 0.06, 0.06, False),
        ((0.0825, -0.077, 0), (0.0825, 0.077, 0), 0.047, 0.047, True),
    ),
    (
        ((0, 0, 0), (-0.0825, 0.075, 0), 0.054, 0.06, False),
        ((-0.0825, 0.04, 0), (-0.0825, 0.115, 0), 0.06, 0.062, False),
        ((-0.0825, 0.11, 0), (-0.0825, 0.125, 0), 0.057, 0.057, True),
    ),
    (
        ((0, 0, -0.26), (0, 0.005, -0.17), 0.062, 0.056, False),
        ((0, 0.02, -0.19), (0, 0.068, -0.01), 0.052, 0.042, False),
        ((0, -0.02, 0), (0, 0.085, 0), 0.05, 0.05, False),
        ((0, -0.027, 0), (0, 0.092, 0), 0.04, 0.04, True),
    ),
    (
        ((0, 0, 0), (0.088, 0, 0), 0.047, 0.05, False),
        ((0.088, -0.03, 0), (0.088, 0.06, 0), 0.05, 0.046, False),
        ((0.088, 0.055, 0), (0.088, 0.066, 0), 0.043, 0.043, True),
    ),
    (
        ((0, 0, 0.02), (0, 0, 0.085), 0.046, 0.044, False),
        ((0, 0, 0.08), (0, 0, 0.108), 0.036, 0.036, True),
    ),
)


def add_appearance(spec: mujoco.MjSpec) -> None:
    """Hide the capsules of the arm, and draw its meshes if they are installed, otherwise its housings."""
    folder = mesh_folder()
    for link, housings in enumerate(_HOUSINGS):
        body = spec.body(f"link{link}")
        for geom in body.geoms:
            geom.group = HIDDEN_GROUP
        surfaces = _housing_surfaces(housings) if folder is None else link_surfaces(folder / f"link{link}.stl")
        for i, ((vertices, faces), dark) in enumerate(surfaces):
            name = f"housing{link}_{i}"
            shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # installed meshes are not closed
            spec.add_mesh(name=name, uservert=vertices.ravel(), userface=faces.ravel(), inertia=shell)
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=name,
                group=VISUAL_GROUP,
                rgba=_DARK if dark else _WHITE,
                contype=0,
                conaffinity=0,
                mass=0,
            )


def _housing_surfaces(housings: tuple[Housing, ...]) -> Iterator[tuple[Surface, bool]]:
    for start, end, first, last, dark in housings:
        yield housing(np.array(start, float), np.array(end, float), first, last, _FILLETS[dark]), dark


def housing(
    start: NDArray[np.float64], end: NDArray[np.float64], first: float, last: float, fillet: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Vertices (V, 3), m, and faces (F, 3) of a closed, tapered cylinder with rounded ends.

    Args:
        start, end: (3,) centres of its end faces, m. first, last: radii there, m. fillet: (F,) angles of the
            vertices of its rounded edges, 0 to pi/2.
    """
    axis = end - start
    length = float(np.linalg.norm(axis))
    axis = axis / length
    side = np.cross(axis, (0.0, 0.0, 1.0) if abs(axis[2]) < 0.9 else (1.0, 0.0, 0.0))
    side /= np.linalg.norm(side)
    rounded = min(0.35 * min(first, last), 0.45 * length)
    radius, along = rounded * np.sin(fillet), rounded * (1.0 - np.cos(fillet))
    radii = np.concatenate([first - rounded + radius, (last - rounded + radius)[::-1]])
    heights = np.concatenate([along, length - along[::-1]])
    ring = np.cos(_TURN)[:, None] * side + np.sin(_TURN)[:, None] * np.cross(axis, side)
    points = start + heights[:, None, None] * axis + radii[:, None, None] * ring
    count, rings = len(_TURN), len(heights)
    vertices = np.concatenate([points.reshape(-1, 3), [start, end]])
    here = np.arange(count)
    right = np.roll(here, -1)
    faces = []
    for level in range(rings - 1):
        low, high = level * count, (level + 1) * count
        faces += [np.stack([low + here, low + right, high + here], 1)]
        faces += [np.stack([low + right, high + right, high + here], 1)]
    top = (rings - 1) * count
    faces += [np.stack([right, here, np.full(count, len(vertices) - 2)], 1)]
    faces += [np.stack([top + here, top + right, np.full(count, len(vertices) - 1)], 1)]
    return vertices, np.concatenate(faces).astype(np.int32)
