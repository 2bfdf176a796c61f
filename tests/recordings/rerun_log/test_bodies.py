"""Robot and object in a recording: the poses are the replay's, the surfaces closed and seen from outside."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.simulation.replay import replay
from beliefscope.datasets.simulation.shapes import shapes
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.figures.meshes import solid
from beliefscope.inspect.trace import Trace, trace
from beliefscope.recordings.write import write_recording


def run_of(task: str, name: str) -> Trace:
    with open_dataset(sample_path(task)) as data:
        return trace(load_checkpoint(shipped(task, name)), data[9], episode_index=9)


@pytest.fixture(scope="module")
def run() -> Trace:
    return run_of("door", "image-ekf")


def columns(path: Path, entity: str) -> dict[str, np.ndarray]:
    """Component -> its rows, end to end, of one entity."""
    found: dict[str, list[np.ndarray]] = {}
    for chunk in RrdReader(path).stream():
        if chunk.entity_path == f"/{entity}":
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                values = batch.column(name)
                while hasattr(values, "flatten") and values.type.num_fields and values.type.id in LISTS:
                    values = values.flatten()
                if values.type.num_fields == 0:
                    found.setdefault(name, []).append(values.to_numpy(zero_copy_only=False))
    return {name: np.concatenate(parts) for name, parts in found.items()}


LISTS = {25, 32, 36}  # pyarrow's ids of lists, of fixed-size lists, of large lists


def test_poses_are_the_replays(run: Trace, tmp_path: Path) -> None:
    write_recording(run, tmp_path / "run.rrd")
    replayed = replay(DOOR, run.episode)
    assert replayed is not None
    body = replayed.model.body("hand").id
    told = columns(tmp_path / "run.rrd", "world/bodies/hand")
    at = told["Transform3D:translation"].reshape(-1, 3)
    turned = told["Transform3D:mat3x3"].reshape(-1, 3, 3).transpose(0, 2, 1)  # Rerun keeps columns
    np.testing.assert_allclose(at, replayed.positions[:, body], atol=1e-6)
    np.testing.assert_allclose(turned, replayed.rotations[:, body], atol=1e-6)
    assert "Mesh3D:vertex_positions" in told


def test_a_puck_is_a_cylinder(tmp_path: Path) -> None:
    write_recording(run_of("push", "image-ekf"), tmp_path / "run.rrd")
    told = columns(tmp_path / "run.rrd", "world/object/truth")
    assert not any(name.startswith("Boxes3D") for name in told)
    np.testing.assert_allclose(told["Cylinders3D:lengths"], 0.06, atol=1e-6)
    np.testing.assert_allclose(told["Cylinders3D:radii"], 0.05, atol=1e-6)


def test_surfaces_are_closed_and_look_outwards(run: Trace) -> None:
    replayed = replay(DOOR, run.episode)
    assert replayed is not None
    for shape in shapes(replayed.model, looks=False):
        made = solid(shape)
        a, b, c = np.moveaxis(made.vertices[made.faces].astype(float), 1, 0)
        across = np.cross(b - a, c - a)
        # The faces of a closed surface cancel, and the body's volume is positive by the divergence theorem.
        np.testing.assert_allclose(across.sum(axis=0), 0.0, atol=1e-6)
        volume = (across * (a + b + c)).sum() / 18.0
        box = np.prod(np.ptp(shape.points, axis=0))
        assert 0.1 * box < volume <= box * (1.0 + 1e-5)
        np.testing.assert_allclose(np.linalg.norm(made.normals, axis=1), 1.0, atol=1e-5)
        centre = made.vertices.mean(axis=0)
        assert ((made.normals * (made.vertices - centre)).sum(axis=1) > 0.0).all()
