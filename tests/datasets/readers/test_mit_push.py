"""Reader of the MIT Push dataset: resampling, contact geometry and stitching."""

from __future__ import annotations

import json
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import mujoco
import numpy as np
import pytest

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.readers.mit_push import AREA, read_push, stitch
from beliefscope.datasets.readers.push_real_task import (
    CAMERA,
    CENTRE,
    CONTACT_GAP,
    PUSH_REAL,
    PUSH_REAL_FIELD,
    PUSH_REAL_TASKS,
    gap,
    render_images,
)
from beliefscope.datasets.simulation.replay import replay
from beliefscope.datasets.simulation.simulate import path_controls
from beliefscope.datasets.store import open_dataset, write_dataset

pytestmark = pytest.mark.slow

REAL = Path(__file__).parents[4] / "shared" / "data" / "mit_push"
NAME = "motion_surface=plywood_shape={}_a=0_v=100_i=0.000_s=0.500_t={:.3f}.json"

Rows = dict[str, Any]


def rows(turn: float = 0.4, seconds: float = 1.0, start: float = 100.0) -> Rows:
    """A push whose quantities are linear in time; the three streams differ in rate and time range."""

    def stream(rate: float, begin: float, end: float, *rates: tuple[float, float]) -> list[list[float]]:
        t = np.arange(begin, end, 1 / rate)
        return np.column_stack([start + t, *(a + b * t for a, b in rates)]).tolist()

    return {
        "object_pose": stream(140, -0.1, seconds, (0.35, 0.02), (-0.03, 0.03), (3.0, turn)),
        "tip_pose": stream(250, 0.0, seconds + 0.1, (0.30, 0.02), (-0.02, 0.03), (0.0, 0.0)),
        "ft_wrench": stream(250, 0.01, seconds + 0.1, (1.0, 2.0), (-1.0, 0.5), (0.01, 0.1)),
    }


def write(folder: Path, content: Rows, angle: float = 0.0, shape: str = "rect1") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / NAME.format(shape, angle)
    path.write_text(json.dumps(content))
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three pushes each in ``train`` and ``val``."""
    folder = tmp_path_factory.mktemp("pushes")
    for number in range(6):
        write(folder / ("train", "val")[number % 2], rows(turn=0.1 * number, seconds=0.9 + 0.05 * number), number)
    return folder


@pytest.mark.parametrize("rate", [18.0, 50.0])
def test_streams_are_resampled_to_a_common_time_range(tmp_path: Path, rate: float) -> None:
    push = read_push(write(tmp_path, rows()), rate)
    t = 0.01 + np.arange(len(push)) / rate  # the latest start of the three streams
    assert len(push) == {18.0: 18, 50.0: 50}[rate]
    poses = np.column_stack([0.35 + 0.02 * t, -0.03 + 0.03 * t, 3.0 + 0.4 * t])
    np.testing.assert_allclose(push.poses, poses, atol=1e-6)
    np.testing.assert_allclose(push.tips, np.column_stack([0.30 + 0.02 * t, -0.02 + 0.03 * t]), atol=1e-6)
    # The mean over a step is the value at its middle; the first step starts at the first row.
    middle = (t + np.maximum(t - 1 / rate, 0.01)) / 2
    np.testing.assert_allclose(push.force, np.column_stack([1 + 2 * middle, -1 + 0.5 * middle]), atol=1e-3)
    np.testing.assert_allclose(push.torque, 0.01 + 0.1 * middle, atol=1e-4)


def test_yaw_is_unwrapped(tmp_path: Path) -> None:
    content = rows()
    expected = read_push(write(tmp_path, content), 18).poses[:, 2]
    assert expected[-1] > np.pi
    for row in content["object_pose"]:
        row[3] = (row[3] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(read_push(write(tmp_path, content), 18).poses[:, 2], expected, atol=1e-9)


def test_repeated_and_late_rows_are_dropped(tmp_path: Path) -> None:
    content = rows()
    expected = read_push(write(tmp_path, content), 18)
    for key in content:
        content[key].insert(20, content[key][19])
        content[key].insert(40, content[key][10])
    np.testing.assert_array_equal(read_push(write(tmp_path, content), 18).poses, expected.poses)


def test_hdf5_and_json_are_equivalent(tmp_path: Path) -> None:
    path = write(tmp_path, rows())
    other = path.with_suffix(".h5")
    with h5py.File(other, "w") as file:
        for key, value in rows().items():
            file[key] = np.array(value)
    first, second = read_push(path, 18), read_push(other, 18)
    for name in ("poses", "tips", "force", "torque"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    with open_dataset(other) as data:
        assert data.task is PUSH_REAL


def test_stitching_is_a_rigid_motion(folder: Path) -> None:
    """The block is continuous between pushes; tip, force and torque are unchanged in the block's frame."""
    pushes = [read_push(path, 18) for path in sorted(folder.rglob("*.json"))]
    trajectory = stitch(iter(pushes), 45, np.random.default_rng(3))
    assert len(trajectory) == 45
    assert trajectory.files == tuple(push.files[0] for push in pushes[: len(trajectory.files)])
    assert abs(trajectory.poses[0, 2]) <= np.pi / 2
    assert (np.abs(trajectory.poses[:, :2] - CENTRE) <= AREA).all()

    def in_block_frame(poses: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        return np.column_stack([c * vectors[:, 0] + s * vectors[:, 1], c * vectors[:, 1] - s * vectors[:, 0]])

    begin = 0
    for push in pushes[: len(trajectory.files)]:
        if begin:
            np.testing.assert_allclose(trajectory.poses[begin], trajectory.poses[begin - 1], atol=1e-12)
        steps = slice(begin, min(begin + len(push), 45))
        part, count = trajectory.poses[steps], len(trajectory.poses[steps])
        for stitched, original in (
            (trajectory.tips[steps] - part[:, :2], push.tips - push.poses[:, :2]),
            (trajectory.force[steps], push.force),
        ):
            np.testing.assert_allclose(
                in_block_frame(part, stitched), in_block_frame(push.poses, original)[:count], atol=1e-12
            )
        np.testing.assert_array_equal(trajectory.torque[steps], push.torque[:count])
        begin += len(push)


@pytest.mark.long
def test_folder_as_a_dataset(folder: Path, tmp_path: Path) -> None:
    with open_dataset(folder) as data:
        assert [s.split for s in data.summaries] == ["train"] * 200 + ["val"] * 50
        assert {s.steps for s in data.summaries} == {45}
        assert data.task is PUSH_REAL
        episode = data[3]
        assert episode.provenance["shape"] == "rect1"
        assert set(episode.provenance["pushes"]) <= {path.name for path in (folder / "train").iterdir()}
        assert data.summaries[3].contact_fraction == pytest.approx(episode.contact.mean())
        digest = data[207].digest()
    with open_dataset(folder / "val") as held_out:
        assert {s.split for s in held_out.summaries} == {"val"}
        assert held_out[7].digest() == digest
        converted = tmp_path / "pushes.h5"
        write_dataset(converted, held_out.task, held_out)
        with open_dataset(converted) as stored:
            assert stored.hash == held_out.hash
            assert stored[7].digest() == digest
        with pytest.raises(BadInput, match=r"Episode 50 is not in .* 0 to 49"):
            held_out[50]


@pytest.mark.parametrize("task", PUSH_REAL_TASKS, ids=lambda task: task.name)
def test_task_variants(folder: Path, task: Any) -> None:
    assert find_task(task.name) is task
    with open_dataset(folder / "val", task) as data:
        episode = data[0]
    steps = {"push-real-field": 144}.get(task.name, 45 if "50hz" not in task.name else 125)
    assert episode.states.shape == (steps, 3 if "yaw" in task.name else 2)
    assert episode.dt * steps == pytest.approx(8.0 if task is PUSH_REAL_FIELD else 2.5)
    assert episode.controls.shape == (steps, task.control_size)
    np.testing.assert_array_equal(episode.states, episode.qpos[:, : episode.states.shape[1]])
    for key, shape in task.observations.items():
        assert episode.observations[key].shape == (steps, *shape)
    # In the replay, the block is at the state and the tip at the effector position.
    replayed = replay(task, episode)
    assert replayed is not None
    block, tip = (mujoco.mj_name2id(replayed.model, mujoco.mjtObj.mjOBJ_BODY, name) for name in ("block", "tip"))
    np.testing.assert_allclose(replayed.positions[:, block, :2], episode.states[:, :2], atol=1e-6)
    np.testing.assert_allclose(
        replayed.positions[:, tip, :2], episode.observations["effector_position"][:, :2], atol=1e-6
    )
    outline = task.outline(episode.states)
    np.testing.assert_allclose(outline.position[:, :2], episode.states[:, :2], atol=1e-6)
    if "yaw" in task.name:
        turned = np.stack([replayed.rotations[:, block, 0, 0], replayed.rotations[:, block, 1, 0]], 1)
        w, z = outline.wxyz[:, 0], outline.wxyz[:, 3]
        np.testing.assert_allclose(np.stack([w * w - z * z, 2 * w * z], 1), turned, atol=1e-6)


@pytest.mark.long
def test_field_task_has_the_recorded_haptics_and_another_camera(folder: Path) -> None:
    with open_dataset(folder / "val", PUSH_REAL_FIELD) as data:
        episodes, again = [data[i] for i in range(12)], data[3]
    black, better = [], []
    with open_dataset(folder / "val", PUSH_REAL_FIELD) as data:
        assert data[3].digest() == again.digest()
    for episode in episodes:
        tips, drawn = episode.observations["effector_position"], episode.provenance["ingredients"]
        assert drawn.keys() == PUSH_REAL_FIELD.ingredients.keys()
        np.testing.assert_array_equal(episode.controls, path_controls(tips))
        away = gap("rect1", episode.qpos[:, :3].astype(float), episode.qpos[:, 3:].astype(float))
        clear = np.abs(away - CONTACT_GAP) > 1e-6  # the joint positions are rounded
        np.testing.assert_array_equal(episode.contact[clear], away[clear] < CONTACT_GAP)
        assert 0.03 <= np.linalg.norm(episode.provenance["start_offset"]) <= 0.05
        lit = episode.observations["image"].max(axis=(1, 2)) > 0
        black.append(1.0 - lit.mean())
        if not lit.any():
            continue
        pose = drawn["camera-pose"]
        camera = CAMERA.moved([pose[axis] for axis in "xyz"], [pose[f"turn_{axis}"] for axis in "xyz"])
        seen = episode.observations["image"][lit].astype(float)
        fit = {
            name: np.corrcoef(seen.ravel(), render_images("rect1", episode.qpos[lit], used).ravel())[0, 1]
            for name, used in (("moved", camera), ("nominal", CAMERA))
        }
        better.append(fit["moved"] > fit["nominal"])
    assert 0.1 < np.mean(black) < 0.7
    assert all(better)


def test_pushes_are_used_equally_often(folder: Path) -> None:
    with open_dataset(folder / "train") as data:
        used = [name for i in range(len(data)) for name in data._trajectories[i][1].files]  # type: ignore[attr-defined]
    counts = [used.count(name) for name in set(used)]
    assert len(counts) == 3
    assert max(counts) - min(counts) <= 1


Edit = Callable[[Rows], object]


def changed(key: str, row: int, column: int, value: object) -> Edit:
    return lambda content: content[key][row].__setitem__(column, value)


def later(key: str, by: float) -> Edit:
    def edit(content: Rows) -> None:
        for row in content[key]:
            row[0] += by

    return edit


def silent(content: Rows) -> None:
    content["tip_pose"] = content["tip_pose"][:20] + content["tip_pose"][170:]


BAD: list[tuple[Edit, str]] = [
    (lambda content: content.pop("tip_pose"), r"has no 'tip_pose'; expected the keys object_pose, tip_pose, ft_wrench"),
    (
        changed("ft_wrench", 7, 2, float("nan")),
        r"'ft_wrench' is \[100\.0\d*, 1\.0\d*, nan, 0\.0\d*\] in row 7, expected fin",
    ),
    (lambda content: content["object_pose"][3].pop(), r"'object_pose' is not a list of rows of 4 numbers"),
    (lambda content: content.update(tip_pose="none"), r"'tip_pose' is not a list of rows of 4 numbers"),
    (lambda content: content.update(tip_pose=[]), r"'tip_pose' is not a list of rows of 4 numbers"),
    (lambda content: content.update(tip_pose=content["tip_pose"][:1]), r"'tip_pose' has 1 row of different times"),
    (silent, r"'tip_pose' has a gap of 0\.60 s after 100\.08 s, expected at most 0\.5 s"),
    (
        later("tip_pose", 5.0),
        r"the time ranges do not overlap: 'object_pose' 99\.90 to 10\d\.\d\d s, 'tip_pose' 105\.00 to 106\.\d\d s, "
        r"'ft_wrench' 100\.01 to 101\.\d\d s; expected an overlap of 0\.06 s",
    ),
    (changed("object_pose", 30, 3, 4.6), r"'object_pose' jumps by 1\.6 rad after 100\.11 s, expected at most 0\.5 rad"),
    (changed("tip_pose", 30, 1, 0.9), r"'tip_pose' jumps by 0\.6 m after 100\.12 s, expected at most 0\.05 m"),
]


@pytest.mark.parametrize(("edit", "message"), BAD)
def test_errors_name_the_cause(tmp_path: Path, edit: Edit, message: str) -> None:
    content = rows()
    edit(content)
    check_rejected(write(tmp_path, content), message)


def check_rejected(path: Path, message: str) -> None:
    with pytest.raises(BadInput, match=message) as error:
        open_dataset(path)
    assert "\n" not in str(error.value)
    assert path.name in str(error.value)


@pytest.mark.parametrize("fraction", [0.0, 0.5, 0.99])
def test_truncated_file(tmp_path: Path, fraction: float) -> None:
    path = write(tmp_path, rows())
    content = path.read_bytes()
    path.write_bytes(content[: int(fraction * len(content))])
    check_rejected(path, "is truncated or not JSON")
    other = path.with_suffix(".h5")
    with h5py.File(other, "w") as file:
        for key, value in rows().items():
            file[key] = np.array(value)
    content = other.read_bytes()
    other.write_bytes(content[: int(fraction * len(content))])
    with pytest.raises(BadInput, match=r"is damaged or truncated|is not an HDF5 file"):
        open_dataset(other)


def test_invalid_stream_needs_little_memory(tmp_path: Path) -> None:
    """A file of 64 KB declares 16 MB of bytes, which would be 128 MB of floats."""
    path = write(tmp_path, rows()).with_suffix(".h5")
    with h5py.File(path, "w") as file:
        file.update({key: value for key, value in rows().items() if key != "tip_pose"})
        file.create_dataset("tip_pose", data=np.zeros(2**24, "u1"), chunks=(2**20,), compression="gzip")
    tracemalloc.start()
    check_rejected(path, r"'tip_pose' is not a list of rows of 4 numbers")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**26


def test_invalid_file_names(tmp_path: Path) -> None:
    check_rejected(write(tmp_path, rows(), shape="butter"), r"shape 'butter' does not exist\. Available: rect1, rect2")
    path = tmp_path / "push.json"
    path.write_text(json.dumps(rows()))
    check_rejected(path, r"push\.json is not named like a push: expected motion_surface=\.\.\._shape=")


def test_invalid_pushes_are_skipped(folder: Path, tmp_path: Path) -> None:
    for path in (folder / "val").iterdir():
        write(tmp_path / "val", json.loads(path.read_text()), float(path.stem.rsplit("=", 1)[1]))
    bad = rows()
    del bad["ft_wrench"]
    path = write(tmp_path / "val", bad, 9.0)
    with pytest.raises(BadInput, match="has no 'ft_wrench'"):
        open_dataset(tmp_path)
    with open_dataset(tmp_path, skip_bad=True) as data, open_dataset(folder / "val") as valid:
        assert data.skipped == (f"{path} has no 'ft_wrench'; expected the keys object_pose, tip_pose, ft_wrench.",)
        assert [data[i].digest() for i in range(3)] == [valid[i].digest() for i in range(3)]
        assert len(data) == len(valid)
    with pytest.raises(BadInput, match=r"has no usable push\. First error: .* has no 'ft_wrench'"):
        open_dataset(path, skip_bad=True)


@pytest.fixture(scope="module")
def real() -> Dataset:
    if not REAL.is_dir():
        pytest.skip(f"needs the recorded pushes, which are not distributed with the project: {REAL}")
    return open_dataset(REAL)


def test_recorded_pushes(real: Dataset) -> None:
    assert [s.split for s in real.summaries] == ["train"] * 200 + ["val"] * 50
    assert {s.policy for s in real.summaries} == {"rect1 on plywood"}
    for split, low, high in (("train", 0.75, 0.9), ("val", 0.85, 1.0)):
        fraction = np.mean([s.contact_fraction for s in real.summaries if s.split == split])
        assert low < fraction < high


def test_recorded_block_moves_only_in_contact(real: Dataset) -> None:
    """Validates the geometry: the block rests without contact, and gaps separate contact from free motion."""
    pushes = [read_push(path, 18) for path in sorted(REAL.rglob("*.json"))]
    motion, distance = [], []
    for push in pushes:
        away = gap(push.shape, push.poses, push.tips)
        distance.append(away)
        free = (away[1:] > CONTACT_GAP) & (away[:-1] > CONTACT_GAP)
        motion.append(np.linalg.norm(np.diff(push.poses[:, :2], axis=0), axis=1)[free])
    assert len(np.concatenate(motion)) > 50
    assert np.concatenate(motion).max() < 0.0015
    away = np.concatenate(distance)
    assert np.quantile(away[away < CONTACT_GAP], 0.02) > -0.002
    assert ((away > 0.0015) & (away < 0.003)).mean() < 0.01
