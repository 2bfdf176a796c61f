"""Meshes of the optional package rtb-data: two-tone, small, and without effect on dynamics and camera images."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.simulation import panda_visual
from beliefscope.datasets.simulation.panda_meshes import FOLDER, PACKAGE, link_surfaces, mesh_folder
from beliefscope.datasets.simulation.panda_visual import VISUAL_GROUP, housing
from beliefscope.datasets.simulation.push import push_model
from beliefscope.datasets.simulation.shapes import shapes

INSTALLED = mesh_folder()
MAX_FACES = 15_000


def stl(*solids: tuple[np.ndarray, np.ndarray]) -> bytes:
    """Binary STL file with the triangles of solids: vertices (V, 3) and faces (F, 3)."""
    corners = np.concatenate([vertices[faces] for vertices, faces in solids]).reshape(-1, 9)
    triangles = np.zeros((len(corners), 50), np.uint8)
    triangles[:, 12:48] = corners.astype("<f4").view(np.uint8)
    return bytes(80) + len(corners).to_bytes(4, "little") + triangles.tobytes()


@pytest.fixture(params=["written", "installed"])
def meshes(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder with meshes: of the package, or of one with files that have the housings of the links."""
    if request.param == "installed":
        if INSTALLED is None:
            pytest.skip("rtb-data is not installed: pip install 'beliefscope[panda]'")
        return INSTALLED
    folder = tmp_path / PACKAGE / FOLDER
    folder.mkdir(parents=True)
    (tmp_path / PACKAGE / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, PACKAGE, raising=False)
    importlib.invalidate_caches()
    for link, housings in enumerate(panda_visual._HOUSINGS):
        solids = [
            housing(np.array(start, float), np.array(end, float), first, last, np.linspace(0.0, np.pi / 2, 4))
            for start, end, first, last, _ in housings
        ]
        (folder / f"link{link}.stl").write_bytes(stl(*solids))
    return folder


def arm(model: Any) -> list[Any]:
    """Displayed shapes of the links that are meshes."""
    return [shape for shape in shapes(model) if shape.faces is not None]


def test_without_the_package_the_arm_has_its_housings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(panda_visual, "mesh_folder", lambda: None)
    assert len(arm(push_model(True))) == sum(map(len, panda_visual._HOUSINGS))


def test_meshes_are_two_tone_and_small(meshes: Path) -> None:
    assert mesh_folder() == meshes
    parts = arm(push_model(True))
    assert {shape.name for shape in parts} == {f"link{i}" for i in range(8)}
    colors = {tuple(shape.rgba.round(2).tolist()) for shape in parts}
    assert colors == {panda_visual._WHITE, panda_visual._DARK}
    assert sum(len(shape.faces) for shape in parts) < MAX_FACES


@pytest.mark.parametrize("link", range(8))
def test_meshes_are_in_the_frames_of_the_links(meshes: Path, link: int, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = arm(push_model(True))
    monkeypatch.setattr(panda_visual, "mesh_folder", lambda: None)
    boxes = [
        np.concatenate([shape.points for shape in parts if shape.name == f"link{link}"])
        for parts in (drawn, arm(push_model(True)))
    ]
    np.testing.assert_allclose(boxes[0].min(axis=0), boxes[1].min(axis=0), atol=0.07)
    np.testing.assert_allclose(boxes[0].max(axis=0), boxes[1].max(axis=0), atol=0.07)


def test_meshes_change_neither_dynamics_nor_images(meshes: Path) -> None:
    plain, displayed = push_model(), push_model(True)
    added = displayed.geom_group == VISUAL_GROUP
    assert not displayed.geom_contype[added].any()
    for before, after in zip(shapes(plain, visual=False), shapes(displayed, visual=False), strict=True):
        np.testing.assert_array_equal(before.points, after.points)
    data = [mujoco.MjData(model) for model in (plain, displayed)]
    for model, state in zip((plain, displayed), data, strict=True):
        mujoco.mj_step(model, state, 50)
    np.testing.assert_array_equal(data[0].qpos, data[1].qpos)


def test_the_largest_connected_part_is_white(tmp_path: Path) -> None:
    end, fillet = np.array([0.0, 0.0, 0.2]), np.linspace(0.0, np.pi / 2, 4)
    large = housing(np.zeros(3), end, 0.06, 0.06, fillet)
    small = [housing(end * side, end * side * 1.1, 0.02, 0.02, fillet) for side in (2.0, 3.0)]
    (tmp_path / "link.stl").write_bytes(stl(small[0], large, small[1]))
    (white, is_dark), (dark, other_is_dark) = link_surfaces(tmp_path / "link.stl")
    assert (is_dark, other_is_dark) == (False, True)
    assert white[0][:, 2].max() == pytest.approx(0.2, abs=0.01)
    assert dark[0][:, 2].min() == pytest.approx(0.4, abs=0.01)


SOLID = stl(housing(np.zeros(3), np.eye(3)[2], 1.0, 1.0, np.zeros(2)))


@pytest.mark.parametrize("content", [b"", b"solid link\nendsolid link\n", SOLID[:-7]])
def test_damaged_meshes_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "link1.stl").write_bytes(content)
    with pytest.raises(BadInput, match=r"link1\.stl is not a binary STL file"):
        link_surfaces(tmp_path / "link1.stl")
    with pytest.raises(BadInput, match=r"link2\.stl of the package rtb-data cannot be read"):
        link_surfaces(tmp_path / "link2.stl")
