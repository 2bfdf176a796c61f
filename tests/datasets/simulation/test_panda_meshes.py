"""Visual meshes of the Panda, from a package created by the tests."""

from __future__ import annotations

import importlib
from pathlib import Path

import mujoco
import numpy as np
import pytest

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation import panda_meshes
from beliefscope.datasets.simulation.door import door_model
from beliefscope.datasets.simulation.door_physics import DoorPhysics
from beliefscope.datasets.simulation.push import push_model

# A tetrahedron of 10 cm with outward faces.
CORNERS = 0.1 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
PHYSICS = DoorPhysics((0.8, -0.3), 0.6)


def write_stl(path: Path, triangles: np.ndarray) -> None:
    """Write a binary STL file. triangles: (F, 3, 3) m."""
    solid = np.zeros(len(triangles), panda_meshes._STL)
    solid["corners"] = triangles
    path.write_bytes(b"\0" * 80 + len(triangles).to_bytes(4, "little") + solid.tobytes())


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Mesh folder of a package that cannot be imported."""
    folder = tmp_path / panda_meshes.PACKAGE / panda_meshes.FOLDER
    folder.mkdir(parents=True)
    (tmp_path / panda_meshes.PACKAGE / "__init__.py").write_text("raise ImportError('must not be imported')\n")
    for name in set(panda_meshes.MESHES.values()):
        write_stl(folder / f"{name}.stl", CORNERS[FACES])
    monkeypatch.syspath_prepend(str(tmp_path))
    importlib.invalidate_caches()
    return folder


@pytest.fixture
def not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide an installed mesh package."""
    monkeypatch.setattr(panda_meshes, "PACKAGE", "no_such_package")


def is_mesh(model: mujoco.MjModel) -> np.ndarray:
    return model.geom_type == mujoco.mjtGeom.mjGEOM_MESH


def test_without_the_package_collision_shapes_are_visible(not_installed: None) -> None:
    assert panda_meshes.mesh_folder() is None
    visual_model = door_model(PHYSICS, visual=True)
    assert not is_mesh(visual_model).any()
    assert (visual_model.geom_group == 0).all()


@pytest.mark.parametrize("build", [lambda visual: door_model(PHYSICS, visual), push_model])
def test_meshes_replace_only_the_visible_shapes(installed: Path, build: object) -> None:
    assert panda_meshes.mesh_folder() == installed
    assert callable(build)
    collision_model, visual_model = build(False), build(True)
    meshes = is_mesh(visual_model)
    assert not is_mesh(collision_model).any()
    bodies = {visual_model.body(b).name for b in visual_model.geom_bodyid[meshes]}
    assert bodies == set(panda_meshes.MESHES)
    assert not visual_model.geom_contype[meshes].any()
    assert not visual_model.geom_conaffinity[meshes].any()
    hidden = np.isin(visual_model.geom_bodyid, visual_model.geom_bodyid[meshes]) & ~meshes
    assert (visual_model.geom_group[hidden] == panda_meshes.HIDDEN_GROUP).all()
    assert (visual_model.geom_group[~hidden] == 0).all()
    for quantity in ("body_mass", "body_inertia", "body_ipos", "body_pos", "body_quat", "jnt_range"):
        np.testing.assert_array_equal(getattr(visual_model, quantity), getattr(collision_model, quantity))
    assert visual_model.ngeom == collision_model.ngeom + len(panda_meshes.MESHES)


def test_vertices_within_a_cell_are_merged(tmp_path: Path) -> None:
    # Additional degenerate triangles at the corners vanish.
    write_stl(tmp_path / "fine.stl", np.concatenate([CORNERS[FACES], CORNERS[FACES][:, [0, 0, 1]]]))
    vertices, faces = panda_meshes.read_stl(tmp_path / "fine.stl")
    assert sorted(map(tuple, vertices.round(6).tolist())) == sorted(map(tuple, CORNERS.round(6).tolist()))
    edges = vertices[faces]
    normals = np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0])
    assert len(faces) == 4
    outwards = edges.mean(axis=1) - vertices.mean(axis=0)
    assert ((normals * outwards).sum(axis=1) > 0).all(), "faces keep their orientation"


def test_other_files_are_rejected(tmp_path: Path) -> None:
    (tmp_path / "text.stl").write_text("solid cube\nendsolid cube\n" * 20)
    with pytest.raises(BadInput, match=r"text\.stl is not a binary STL file"):
        panda_meshes.read_stl(tmp_path / "text.stl")
