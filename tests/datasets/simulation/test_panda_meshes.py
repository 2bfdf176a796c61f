"""The Panda's meshes, of a package made for the tests: read where they are installed, and only for the eye."""

from __future__ import annotations

import importlib
from pathlib import Path

import mujoco
import numpy as np
import pytest

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation import panda_meshes
from beliefscope.datasets.simulation.door import DoorPhysics, door_model
from beliefscope.datasets.simulation.push import push_model

# A tetrahedron of 10 cm, its faces seen from outside.
CORNERS = 0.1 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
PHYSICS = DoorPhysics((0.8, -0.3), 0.6)


def write_stl(path: Path, triangles: np.ndarray) -> None:
    """(F, 3, 3) m."""
    solid = np.zeros(len(triangles), panda_meshes._STL)
    solid["corners"] = triangles
    path.write_bytes(b"\0" * 80 + len(triangles).to_bytes(4, "little") + solid.tobytes())


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a package that holds the meshes, and cannot be imported."""
    folder = tmp_path / panda_meshes.PACKAGE / panda_meshes.FOLDER
    folder.mkdir(parents=True)
    (tmp_path / panda_meshes.PACKAGE / "__init__.py").write_text("raise ImportError('it is read, not imported')\n")
    for name in set(panda_meshes.MESHES.values()):
        write_stl(folder / f"{name}.stl", CORNERS[FACES])
    monkeypatch.syspath_prepend(str(tmp_path))
    importlib.invalidate_caches()
    return folder


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is installed, whatever is."""
    monkeypatch.setattr(panda_meshes, "PACKAGE", "no_such_package")


def is_mesh(model: mujoco.MjModel) -> np.ndarray:
    return model.geom_type == mujoco.mjtGeom.mjGEOM_MESH


def test_without_the_package_the_shapes_are_what_is_seen(bare: None) -> None:
    assert panda_meshes.mesh_folder() is None
    dressed = door_model(PHYSICS, looks=True)
    assert not is_mesh(dressed).any()
    assert (dressed.geom_group == 0).all()


@pytest.mark.parametrize("build", [lambda looks: door_model(PHYSICS, looks), push_model])
def test_meshes_take_the_shapes_places_and_nothing_else(installed: Path, build: object) -> None:
    assert panda_meshes.mesh_folder() == installed
    assert callable(build)
    plain, dressed = build(False), build(True)
    meshes = is_mesh(dressed)
    assert not is_mesh(plain).any()
    named = {dressed.body(b).name for b in dressed.geom_bodyid[meshes]}
    assert named == set(panda_meshes.MESHES)
    assert not dressed.geom_contype[meshes].any()
    assert not dressed.geom_conaffinity[meshes].any()
    ours = np.isin(dressed.geom_bodyid, dressed.geom_bodyid[meshes]) & ~meshes
    assert (dressed.geom_group[ours] == panda_meshes.HIDDEN_GROUP).all()
    assert (dressed.geom_group[~ours] == 0).all()
    for quantity in ("body_mass", "body_inertia", "body_ipos", "body_pos", "body_quat", "jnt_range"):
        np.testing.assert_array_equal(getattr(dressed, quantity), getattr(plain, quantity))
    assert dressed.ngeom == plain.ngeom + len(panda_meshes.MESHES)


def test_vertices_of_one_cell_become_one(tmp_path: Path) -> None:
    # Each edge of the tetrahedron is halved a tenth of a cell beside its first corner: the slivers vanish.
    write_stl(tmp_path / "fine.stl", np.concatenate([CORNERS[FACES], CORNERS[FACES][:, [0, 0, 1]]]))
    vertices, faces = panda_meshes.read_stl(tmp_path / "fine.stl")
    assert sorted(map(tuple, vertices.round(6).tolist())) == sorted(map(tuple, CORNERS.round(6).tolist()))
    edges = vertices[faces]
    normals = np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0])
    assert len(faces) == 4
    outwards = edges.mean(axis=1) - vertices.mean(axis=0)
    assert ((normals * outwards).sum(axis=1) > 0).all(), "faces still look outwards"


def test_another_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.stl").write_text("solid cube\nendsolid cube\n" * 20)
    with pytest.raises(BadInput, match=r"text\.stl is not a binary STL file"):
        panda_meshes.read_stl(tmp_path / "text.stl")
