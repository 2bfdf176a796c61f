"""Meshes of the Panda's arm, read from the files of the optional package rtb-data, which is not imported."""

from __future__ import annotations

import importlib.util
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput

PACKAGE = "rtbdata"
FOLDER = Path("meshes", "FRANKA-EMIKA", "Panda")
CELL = 0.010  # m; merging the vertices in a cell removes half of the faces, for 5 frames/s without a GPU
MIN_AREA = 1e-3  # m^2; smaller dark surfaces are not drawn
_SAME = 1e-6  # m between vertices of a file that are the same point
_STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_HEADER = 84  # bytes; the last four are the number of faces

Surface = tuple[NDArray[np.float64], NDArray[np.int32]]
"""Vertices (V, 3), m, and faces (F, 3)."""


def mesh_folder() -> Path | None:
    """Folder with the meshes; None if the package is not installed."""
    spec = importlib.util.find_spec(PACKAGE)
    folders = [Path(place) / FOLDER for place in (spec and spec.submodule_search_locations) or ()]
    return next((folder for folder in folders if folder.is_dir()), None)


@cache
def link_surfaces(path: Path) -> tuple[tuple[Surface, bool], ...]:
    """Surfaces of a binary STL file, each with whether it is dark.

    The files have no colours. The largest connected part of a link is its white housing, the others are covers,
    seals and connectors.
    """
    corners = _read_stl(path)
    _, index = _merged(corners, _SAME)
    part = _parts(index)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2.0
    white = part == np.bincount(part, area).argmax()
    result = [(_coarse(corners[white]), False)]
    if area[~white].sum() >= MIN_AREA:
        result.append((_coarse(corners[~white]), True))
    return tuple(result)


def _read_stl(path: Path) -> NDArray[np.float64]:
    """(F, 3, 3) m, corners of the triangles."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BadInput(f"The mesh {path} of the package rtb-data cannot be read: {error.strerror}.") from None
    count = int.from_bytes(data[_STL_HEADER - 4 : _STL_HEADER], "little")
    if not count or len(data) != _STL_HEADER + count * _STL.itemsize:
        raise BadInput(f"{path} is not a binary STL file: {len(data)} bytes for {count} faces.")
    return np.frombuffer(data, _STL, offset=_STL_HEADER)["corners"].astype(float)


def _merged(corners: NDArray[np.float64], cell: float) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Mean points (V, 3) of the corners in each cell, and faces (F, 3)."""
    points = corners.reshape(-1, 3)
    x, y, z = (np.rint(points / cell).astype(np.int64) + (1 << 20)).T
    _, index, count = np.unique((x << 42) | (y << 21) | z, return_inverse=True, return_counts=True)
    sums = [np.bincount(index, coordinate) for coordinate in points.T]
    return np.stack(sums, axis=1) / count[:, None], index.reshape(-1, 3)


def _parts(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """(F,) connected part of each face, as the smallest index of its vertices."""
    label = np.arange(faces.max() + 1)
    while True:
        lowest: NDArray[np.int64] = label[faces].min(axis=1)
        new = label.copy()
        np.minimum.at(new, faces, lowest[:, None])
        new = new[new]
        if (new == label).all():
            return lowest
        label = new


def _coarse(corners: NDArray[np.float64]) -> Surface:
    vertices, faces = _merged(corners, CELL)
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return vertices, np.unique(faces[whole], axis=0).astype(np.int32)
