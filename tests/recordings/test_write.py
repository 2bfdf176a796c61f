"""Writing recordings: exact round trip, documented paths, and atomic files."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rerun.chunk import RrdReader

from beliefscope.datasets.errors import BadInput
from beliefscope.inspect.maps.map_engine import LikelihoodMap
from beliefscope.inspect.palette import colour
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.rerun_log.entities import PARTICLE_GRID
from beliefscope.recordings.schema import HEADER, PROPERTIES, SCHEMA, STEP, TIME, Entity
from beliefscope.recordings.write import (
    CHUNKS,
    STEPS_PER_CHUNK,
    STEPS_WITH_PARTICLES,
    chunks,
    steps_per_chunk,
    write_recording,
)

pytestmark = pytest.mark.slow

MapMaker = Callable[..., LikelihoodMap]
Compare = Callable[[Trace, Trace], None]


def expected_paths(trace: Trace, entity: Entity, maps: bool) -> set[str]:
    """Paths of one row of the schema in the recording of this trace."""
    task = trace.task
    present = {
        "always": True,
        "modalities": len(trace.modalities) > 0,
        "covariance": trace.has_covariance,
        "weights": trace.weights is not None,
        "effective_weights": trace.effective_weights is not None,
        "points": bool(task.scans or task.clouds),
        "time": trace.episode.time is not None,
        "covariates": bool(trace.episode.covariates),
        "contact": "contact" in task.covariates,
        "ekf": trace.kind in ("ekf", "ukf"),
        "sensors": trace.observation_mean is not None,
        "pf": trace.kind == "pf",
        "sample": trace.all_particles_ess is not None,
        "measurements": trace.innovation is not None,
        "extra": bool(trace.extra),
        "maps": maps,
        "diagnostics": False,  # tests/recordings/rerun_log/test_diagnostics.py
        "replay": trace.episode.qpos.size > 0,
        "bodies": False,  # tests/recordings/rerun_log/test_bodies.py
        "outline": task.outline is not None,
    }
    if not present[entity.needs]:
        return set()
    values = {
        "{component}": [c.name for c in task.components],
        "{angle}": [c.name for c in task.components if c.unit == "rad"],
        "{modality}": list(trace.modalities),
        "{source}": ["fused", *trace.modalities],
        "{state}": ["truth", "fused"],
        "{layer}": [*trace.modalities, "fused"],
        "{key}": list(trace.episode.observations),
    }
    paths = {entity.path}
    for name, choices in values.items():
        paths = {path.replace(name, choice) for path in paths for choice in choices}
    return {path.replace("+", "\\+") for path in paths}


def written(path: Path) -> Iterator[tuple[str, list[str]]]:
    for chunk in RrdReader(path).stream():
        yield chunk.entity_path.removeprefix("/"), chunk.to_record_batch().schema.names


def test_round_trip_is_exact(trace: Trace, assert_same: Compare, tmp_path: Path) -> None:
    write_recording(trace, tmp_path / "run.rrd")
    assert_same(trace, read_recording(tmp_path / "run.rrd"))


@pytest.mark.parametrize("steps", [0, 1, STEPS_PER_CHUNK, STEPS_PER_CHUNK + 1, 9_999, 10_001, 123_457])
def test_chunks_cover_all_steps_once(steps: int) -> None:
    """Rerun keeps an index of every chunk in memory, so their number is limited."""
    parts = list(chunks(steps))
    assert [step for first, last in parts for step in range(first, last)] == list(range(steps))
    assert len(parts) <= CHUNKS
    assert all(last - first >= STEPS_PER_CHUNK for first, last in parts[:-1])


def test_chunks_of_many_particles_have_fewer_steps(new_trace: Callable[..., Trace]) -> None:
    assert steps_per_chunk(new_trace("ekf", steps=2)) == STEPS_PER_CHUNK
    assert steps_per_chunk(new_trace("pf", steps=2, particles=300)) == STEPS_PER_CHUNK
    assert steps_per_chunk(new_trace("pf", steps=2, particles=1000)) == 300
    assert steps_per_chunk(new_trace("pf", steps=2, particles=10_000)) == STEPS_WITH_PARTICLES


def test_displayed_particles_are_sorted_by_weight(new_trace: Callable[..., Trace], tmp_path: Path) -> None:
    """Each particle has the colour of its weight; the heaviest is drawn last, above all others."""
    trace = new_trace("pf", steps=4, particles=50)
    assert trace.particles is not None
    assert trace.log_weights is not None
    write_recording(trace, tmp_path / "run.rrd")
    stream = RrdReader(tmp_path / "run.rrd").stream().filter(content="/world/plane/particles").drop(is_static=True)
    (batch,) = (chunk.to_record_batch() for chunk in stream)
    points = batch.column("Points3D:positions").flatten().flatten().to_numpy().reshape(4, 50, 3)[..., :2]
    colours = batch.column("Points3D:colors").flatten().to_numpy().reshape(4, 50)
    order = np.argsort(trace.log_weights, axis=1)
    expected = np.take_along_axis(trace.particles[..., list(trace.task.floor or ())], order[..., None], 1)
    np.testing.assert_allclose(points, expected, atol=PARTICLE_GRID)
    full = int(colour("fused", trace.modalities)[1:], 16) << 8 | 255
    assert (colours[:, -1] == full).all()
    assert len(np.unique(colours)) > 4


def test_round_trip_of_several_chunks_and_special_numbers(
    new_trace: Callable[..., Trace], assert_same: Compare, tmp_path: Path
) -> None:
    trace = new_trace("pf", steps=STEPS_PER_CHUNK + 213, particles=7)
    assert trace.log_likelihood is not None
    trace.log_likelihood[5, 0, :3] = np.nan, -np.inf, np.float32(1e-45)
    write_recording(trace, tmp_path / "run.rrd")
    assert_same(trace, read_recording(tmp_path / "run.rrd"))


def test_trace_without_weights_and_joint_positions(
    new_trace: Callable[..., Trace], assert_same: Compare, tmp_path: Path
) -> None:
    trace = new_trace("ekf")
    trace = replace(
        trace,
        weights=None,
        effective_weights=None,
        episode=replace(trace.episode, qpos=np.zeros((len(trace), 0), np.float32)),
    )
    write_recording(trace, tmp_path / "run.rrd")
    imported = read_recording(tmp_path / "run.rrd")
    assert_same(trace, imported)
    assert imported.weights is None


@pytest.mark.parametrize("with_maps", [False, True])
def test_paths_match_the_schema(trace: Trace, new_map: MapMaker, tmp_path: Path, with_maps: bool) -> None:
    maps = [new_map(trace, step) for step in (0, 20)] if with_maps else None
    write_recording(trace, tmp_path / "run.rrd", maps)
    recorded: dict[str, set[str]] = {}
    for path, columns in written(tmp_path / "run.rrd"):
        recorded.setdefault(path, set()).update(columns)
    assert set(PROPERTIES) <= recorded[HEADER]
    for entity in SCHEMA:
        for path in expected_paths(trace, entity, with_maps):
            archetypes = {column.split(":")[0] for column in recorded.get(path, set())}
            assert archetypes & set(entity.archetype.split(" or ")), (path, archetypes)
            assert entity.static or {STEP, TIME} <= recorded[path], path
    expected = {path for entity in SCHEMA for path in expected_paths(trace, entity, with_maps)}
    assert {path for path in recorded if not path.startswith("__properties")} == expected


def test_time_is_step_times_dt(trace: Trace, tmp_path: Path) -> None:
    write_recording(trace, tmp_path / "run.rrd")
    for chunk in RrdReader(tmp_path / "run.rrd").stream().filter(content="/trace/states"):
        batch = chunk.to_record_batch()
        seconds = batch.column(TIME).to_numpy().astype(np.int64) / 1e9
        np.testing.assert_allclose(seconds, batch.column(STEP).to_numpy() * trace.episode.dt, atol=1e-9)


def test_precision_of_maps(new_trace: Callable[..., Trace], new_map: MapMaker, tmp_path: Path) -> None:
    trace = new_trace("pf")
    map_ = new_map(trace, 12, size=41)
    write_recording(trace, tmp_path / "run.rrd", iter([map_]))
    values = {}
    for chunk in RrdReader(tmp_path / "run.rrd").stream().filter(content="/maps/haptics/**"):
        batch = chunk.to_record_batch()
        for name in ("EncodedDepthImage:blob", "Scalars:scalars"):
            if name in batch.schema.names:
                assert batch.column(STEP).to_pylist() == [12]
                values[name] = batch.column(name)
    png = values["EncodedDepthImage:blob"].flatten().flatten().to_numpy().tobytes()
    image = Image.open(BytesIO(png))
    assert image.mode == "I;16", "the viewer draws images of 8 bits black"
    shares = np.asarray(image)[::-1] / 255.0
    log_peak = values["Scalars:scalars"].flatten().to_numpy()[0]
    likelihood = np.exp(map_.log_likelihood[1].astype(float))
    assert np.abs(shares * np.exp(log_peak) - likelihood).max() <= likelihood.max() / 510 * 1.0001


def test_maps_are_labelled_with_their_step(trace: Trace, new_map: MapMaker, tmp_path: Path) -> None:
    write_recording(trace, tmp_path / "run.rrd", [new_map(trace, step) for step in (0, 20)])
    labels = {}
    for chunk in RrdReader(tmp_path / "run.rrd").stream().filter(content="/maps/step"):
        batch = chunk.to_record_batch()
        if "Points2D:labels" in batch.schema.names:
            labels = dict(zip(batch.column(STEP).to_pylist(), batch.column("Points2D:labels").to_pylist(), strict=True))
    assert labels == {0: ["step 0"], 20: ["step 20"]}


def test_recording_has_one_layout(trace: Trace, tmp_path: Path) -> None:
    write_recording(trace, tmp_path / "run.rrd")
    assert len(RrdReader(tmp_path / "run.rrd").blueprints()) == 1


def test_rerun_verifies_the_file(trace: Trace, new_map: MapMaker, tmp_path: Path) -> None:
    path = write_recording(trace, tmp_path / "run.rrd", [new_map(trace, 3)])
    rerun = shutil.which("rerun", path=os.path.dirname(sys.executable)) or shutil.which("rerun")
    if rerun is None:
        pytest.skip("the rerun command is not installed")
    home = {"HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path)}
    done = subprocess.run([rerun, "rrd", "verify", path], capture_output=True, text=True, env=os.environ | home)
    assert done.returncode == 0, done.stderr


def test_the_layout_follows_the_first_steps(trace: Trace, tmp_path: Path) -> None:
    """A viewer warns of a layout that arrives before its timeline."""
    path = write_recording(trace, tmp_path / "run.rrd")
    rerun = shutil.which("rerun", path=os.path.dirname(sys.executable)) or shutil.which("rerun")
    if rerun is None:
        pytest.skip("the rerun command is not installed")
    done = subprocess.run([rerun, "rrd", "print", path], capture_output=True, text=True, check=True)
    assert 0 < done.stdout.index(" - /trace/states - ") < done.stdout.index("Blueprint:")


def test_progress_increases_to_one(trace: Trace, new_map: MapMaker, tmp_path: Path) -> None:
    shares: list[float] = []
    write_recording(trace, tmp_path / "run.rrd", (new_map(trace, s) for s in range(0, 40, 2)), shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_failure_keeps_the_existing_file(trace: Trace, new_map: MapMaker, tmp_path: Path) -> None:
    path = write_recording(trace, tmp_path / "run.rrd")
    before = path.read_bytes()

    def failing() -> Iterator[LikelihoodMap]:
        yield from (new_map(trace, step) for step in range(20))
        assert path.read_bytes() == before
        raise RuntimeError("map failure")

    with pytest.raises(RuntimeError, match="map failure"):
        write_recording(trace, path, failing())
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


KILLED = """
import os, signal, sys
sys.path.insert(0, {folder!r})
from conftest import make_map, make_trace
from beliefscope.recordings.write import write_recording
trace = make_trace("pf")
def maps():
    yield from (make_map(trace, step) for step in range(20))
    os.kill(os.getpid(), signal.SIGKILL)
write_recording(trace, {path!r}, maps())
"""


@pytest.mark.long
def test_killed_writer_leaves_no_file(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    script = KILLED.format(folder=str(Path(__file__).parent), path=str(path))
    assert subprocess.run([sys.executable, "-c", script]).returncode == -9
    assert not path.exists()
    assert all(path.name.startswith(".run.rrd.") for path in tmp_path.iterdir())


@pytest.mark.parametrize("where", ["nowhere/run.rrd", "folder"])
def test_unwritable_path(trace: Trace, tmp_path: Path, where: str) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(BadInput, match="cannot write"):
        write_recording(trace, tmp_path / where)
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_inconsistent_maps(trace: Trace, new_map: MapMaker, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="same size and layers"):
        write_recording(trace, tmp_path / "run.rrd", [new_map(trace, 0), new_map(trace, 1, size=21)])
    with pytest.raises(BadInput, match="map of step 40: the trace has steps 0 to 39"):
        write_recording(trace, tmp_path / "run.rrd", [replace(new_map(trace, 0), step=40)])
    assert not list(tmp_path.iterdir())


def test_threads_of_rerun_end(trace: Trace, tmp_path: Path) -> None:
    def threads() -> int:
        return len(os.listdir("/proc/self/task"))

    if not Path("/proc/self/task").is_dir():
        pytest.skip("needs /proc to see Rerun's threads")
    counts = []
    for number in range(4):
        write_recording(trace, tmp_path / f"{number}.rrd")
        counts.append(threads())
    assert counts[3] <= counts[0]
