"""Robot and object in a recording: poses equal the replay's, meshes are closed with outward normals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation

from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.simulation.replay import replay
from beliefscope.datasets.simulation.shapes import shapes
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.figures.meshes import mesh_of
from beliefscope.inspect.trace import Trace, trace
from beliefscope.recordings.write import write_recording


def traced(task: str, name: str) -> Trace:
    with open_dataset(sample_path(task)) as data:
        return trace(load_checkpoint(pretrained_path(task, name)), data[9], episode_index=9)


@pytest.fixture(scope="module")
def run() -> Trace:
    return traced("door", "image-ekf")


def columns(path: Path, entity: str) -> dict[str, np.ndarray]:
    """Component -> concatenated rows of one entity."""
    rows: dict[str, list[np.ndarray]] = {}
    for chunk in RrdReader(path).stream():
        if chunk.entity_path == f"/{entity}":
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                values = batch.column(name)
                while hasattr(values, "flatten") and values.type.num_fields and values.type.id in LISTS:
                    values = values.flatten()
                if values.type.num_fields == 0:
                    rows.setdefault(name, []).append(values.to_numpy(zero_copy_only=False))
    return {name: np.concatenate(parts) for name, parts in rows.items()}


LISTS = {25, 32, 36}  # pyarrow's ids of lists, of fixed-size lists, of large lists


def test_poses_equal_the_replay(run: Trace, tmp_path: Path) -> None:
    write_recording(run, tmp_path / "run.rrd")
    replayed = replay(DOOR, run.episode)
    assert replayed is not None
    body = replayed.model.body("hand").id
    recorded = columns(tmp_path / "run.rrd", "world/bodies/hand")
    positions = recorded["Transform3D:translation"].reshape(-1, 3)
    rotations = Rotation.from_quat(recorded["Transform3D:quaternion"].reshape(-1, 4)).as_matrix()
    np.testing.assert_allclose(positions, replayed.positions[:, body], atol=1e-6)
    np.testing.assert_allclose(rotations, replayed.rotations[:, body], atol=1e-6)
    assert "Mesh3D:vertex_positions" in recorded


def test_bodies_that_cannot_move_have_one_pose(run: Trace, tmp_path: Path) -> None:
    write_recording(run, tmp_path / "run.rrd")
    replayed = replay(DOOR, run.episode)
    assert replayed is not None
    recorded = columns(tmp_path / "run.rrd", "world/bodies/link0")
    body = replayed.model.body("link0").id
    assert recorded["Transform3D:translation"].shape == (3,)
    np.testing.assert_allclose(recorded["Transform3D:translation"], replayed.positions[0, body], atol=1e-6)
    assert (replayed.positions[:, body] == replayed.positions[0, body]).all()


def test_puck_is_a_cylinder(tmp_path: Path) -> None:
    write_recording(traced("push", "image-ekf"), tmp_path / "run.rrd")
    recorded = columns(tmp_path / "run.rrd", "world/object/truth")
    assert not any(name.startswith("Boxes3D") for name in recorded)
    np.testing.assert_allclose(recorded["Cylinders3D:lengths"], 0.06, atol=1e-6)
    np.testing.assert_allclose(recorded["Cylinders3D:radii"], 0.05, atol=1e-6)


def test_meshes_are_closed_with_outward_normals(run: Trace) -> None:
    replayed = replay(DOOR, run.episode)
    assert replayed is not None
    for shape in shapes(replayed.model, visual=False):
        mesh = mesh_of(shape)
        a, b, c = np.moveaxis(mesh.vertices[mesh.faces].astype(float), 1, 0)
        normals = np.cross(b - a, c - a)
        # Face normals of a closed surface sum to zero; by the divergence theorem the volume is positive.
        np.testing.assert_allclose(normals.sum(axis=0), 0.0, atol=1e-6)
        volume = (normals * (a + b + c)).sum() / 18.0
        box = np.prod(np.ptp(shape.points, axis=0))
        assert 0.1 * box < volume <= box * (1.0 + 1e-5)
        np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-5)
        centre = mesh.vertices.mean(axis=0)
        assert ((mesh.normals * (mesh.vertices - centre)).sum(axis=1) > 0.0).all()
