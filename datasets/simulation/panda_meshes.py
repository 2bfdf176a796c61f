"""Visual meshes of the Panda for replays, if the optional package gymnasium-robotics is installed.

The camera never sees them. The mesh files are read without importing the package.
"""

from __future__ import annotations

import importlib.util
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput

PACKAGE = "gymnasium_robotics"
FOLDER = Path("envs", "assets", "kitchen_franka", "franka_assets", "meshes", "visual")
CELL = 0.005  # m: vertices within a cell are merged, which keeps a fifth of the faces
MESHES = {f"link{i}": f"link{i}" for i in range(8)} | {
    "hand": "hand",
    "finger_left": "finger",
    "finger_right": "finger",
}
"""Body -> mesh."""
HIDDEN_GROUP = 3
"""Geoms of this group and above are not drawn by MuJoCo's viewers and the page."""

_DARK, _WHITE = (0.25, 0.27, 0.3, 1.0), (0.92, 0.93, 0.94, 1.0)
_STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_HEADER = 84  # bytes, the last four the number of faces


def mesh_folder() -> Path | None:
    """Folder of the meshes, or None if they are not installed."""
    package = importlib.util.find_spec(PACKAGE)
    for place in (package and package.submodule_search_locations) or ():
        if (Path(place) / FOLDER).is_dir():
            return Path(place) / FOLDER
    return None


def add_visual_meshes(spec: mujoco.MjSpec) -> None:
    """Add the meshes, if installed, and hide the collision shapes of the Panda."""
    folder = mesh_folder()
    if folder is None:
        return
    for mesh in dict.fromkeys(MESHES.values()):
        vertices, faces = read_stl(folder / f"{mesh}.stl")
        shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # the meshes are not closed
        spec.add_mesh(name=mesh, uservert=vertices.ravel(), userface=faces.ravel(), inertia=shell)
    for name, mesh in MESHES.items():
        body = spec.body(name)
        for geom in body.geoms:
            geom.group = HIDDEN_GROUP
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=mesh,
            quat=(0, 0, 0, 1) if name == "finger_right" else (1, 0, 0, 0),
            rgba=_DARK if mesh == "finger" else _WHITE,
            contype=0,
            conaffinity=0,
            mass=0,
        )


@cache
def read_stl(path: Path) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Vertices (V, 3), m, and faces (F, 3) of a binary STL file. Vertices within a ``CELL`` are merged.

    Raises BadInput for other files.
    """
    data = path.read_bytes()
    count = int.from_bytes(data[_STL_HEADER - 4 : _STL_HEADER], "little")
    if len(data) != _STL_HEADER + count * _STL.itemsize:
        raise BadInput(f"{path} is not a binary STL file")
    corners = np.frombuffer(data, _STL, offset=_STL_HEADER)["corners"].reshape(-1, 3)
    _, joined, shared = np.unique(
        np.rint(corners / CELL).astype(np.int32), axis=0, return_inverse=True, return_counts=True
    )
    joined = joined.ravel()
    vertices = np.zeros((len(shared), 3))
    np.add.at(vertices, joined, corners)
    faces = joined.reshape(-1, 3)
    valid = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return (vertices / shared[:, None]).astype(np.float32), np.unique(faces[valid], axis=0).astype(np.int32)
