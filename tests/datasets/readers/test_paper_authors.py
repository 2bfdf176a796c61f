"""Reader of the HDF5 files used by the authors of the paper."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from beliefscope.datasets.catalog import TASKS
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.readers.hdf5_guard import mark_readable
from beliefscope.datasets.store import open_dataset, write_dataset

pytestmark = pytest.mark.slow

Arrays = dict[str, np.ndarray]


def floats(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.normal(size=shape).astype(np.float32)


def contacts(rng: np.random.Generator, steps: int) -> np.ndarray:
    return (rng.random(steps) < 0.5).astype(np.float32)


def door(rng: np.random.Generator, steps: int) -> Arrays:
    """Trajectory of ``panda_door_*`` files, including unused keys."""
    unused = {"eef_quat": (4,), "gripper_qpos": (2,), "joint_pos": (7,), "robot-state": (40,)}
    return {
        "object-state": np.column_stack([contacts(rng, steps), floats(rng, steps, 4)]),
        "eef_pos": floats(rng, steps, 3),
        "ee-force-obs": floats(rng, steps, 3),
        "ee-torque-obs": floats(rng, steps, 3),
        "contact-obs": contacts(rng, steps),
        "image": rng.uniform(-1, 1, (steps, 64, 64)).astype(np.float32),
        **{key: floats(rng, steps, *shape) for key, shape in unused.items()},
    }


def push(rng: np.random.Generator, steps: int) -> Arrays:
    return {
        "Cylinder0_pos": floats(rng, steps, 3),
        "eef_pos": floats(rng, steps, 3),
        "force": floats(rng, steps, 6),
        "contact": contacts(rng, steps),
        "image": rng.uniform(-1, 1, (steps, 32, 32)).astype(np.float32),
        "object-state": floats(rng, steps, 10),
    }


def kloss(rng: np.random.Generator, steps: int) -> Arrays:
    return {
        "pos": floats(rng, steps, 3),
        "tip": floats(rng, steps, 3),
        "force": floats(rng, steps, 3),
        "contact": contacts(rng, steps),
        "image": rng.integers(0, 256, (steps, 32, 32, 3)).astype(np.float32),
    }


def write(path: Path, create: Callable[[np.random.Generator, int], Arrays], count: int, steps: int = 6) -> list[Arrays]:
    """Write trajectories in the authors' format: float32, lzf compression."""
    rng = np.random.default_rng(len(path.name))
    trajectories = [create(rng, steps + number % 3) for number in range(count)]
    with h5py.File(path, "w") as file:
        for number, arrays in enumerate(trajectories):
            for key, array in arrays.items():
                file.create_dataset(f"trajectory{number}/{key}", data=array, compression="lzf")
    mark_readable(path)
    return trajectories


def test_door_files(tmp_path: Path) -> None:
    """Files for training and testing form one dataset; states have the component order of the task."""
    names = [f"panda_door_{kind}_{count}.hdf5" for kind in ("pull", "push") for count in (10, 100)]
    written = {name: write(tmp_path / name, door, 3 if "10." in name else 2) for name in names}
    with open_dataset(tmp_path) as data:
        assert data.task is TASKS["door"]
        assert [s.policy for s in data.summaries] == ["pull"] * 5 + ["push"] * 5
        assert [s.split for s in data.summaries] == (["test"] * 3 + ["train"] * 2) * 2
        assert data.held_out() == [0, 1, 2, 5, 6, 7]
        order = [(name, i) for name in names for i in range(len(written[name]))]
        for index, (name, number) in enumerate(order):
            expected, episode = written[name][number], data[index]
            _, angle, _, x, y = expected["object-state"].T
            np.testing.assert_array_equal(episode.states, np.column_stack([x, y, angle]))
            np.testing.assert_array_equal(episode.contact, expected["object-state"][:, 0] == 1)
            observations = episode.observations
            np.testing.assert_array_equal(observations["effector_position"], expected["eef_pos"])
            np.testing.assert_array_equal(observations["force"], expected["ee-force-obs"])
            np.testing.assert_array_equal(observations["torque"], expected["ee-torque-obs"])
            np.testing.assert_array_equal(observations["contact"][:, 0], expected["contact-obs"])
            assert observations["image"].dtype == np.uint8
            gray = expected["image"][:, ::2, ::2]
            assert np.abs(observations["image"] / 255 * 2 - 1 - gray).max() <= 1 / 255 + 1e-6
            np.testing.assert_array_equal(episode.controls[1:, :3], expected["eef_pos"][:-1])
            assert (episode.provenance["source"], episode.provenance["trajectory"]) == (name, f"trajectory{number}")
            assert episode.dt == 0.05


def test_trajectories_are_ordered_by_number(tmp_path: Path) -> None:
    written = write(tmp_path / "panda_door_pull_100.hdf5", door, 12)
    with open_dataset(tmp_path / "panda_door_pull_100.hdf5") as data:
        assert [len(e) for e in data] == [len(t["image"]) for t in written]
        np.testing.assert_array_equal(data[10].states[:, 0], written[10]["object-state"][:, 3])


def test_push_file(tmp_path: Path) -> None:
    path = tmp_path / "gentle_push_10.hdf5"
    (expected,) = write(path, push, 1)
    with open_dataset(path) as data:
        assert data.task is TASKS["push"]
        assert data.summaries[0].split == "test"
        assert data.summaries[0].contact_fraction == pytest.approx(expected["contact"].mean())
        episode = data[0]
    np.testing.assert_array_equal(episode.states, expected["Cylinder0_pos"][:, :2])
    np.testing.assert_array_equal(episode.observations["force"], expected["force"][:, :3])
    np.testing.assert_array_equal(episode.observations["torque"], expected["force"][:, 3:])
    np.testing.assert_array_equal(episode.contact, expected["contact"] == 1)
    assert np.abs(episode.observations["image"] / 255 * 2 - 1 - expected["image"]).max() <= 1 / 255 + 1e-6


@pytest.mark.parametrize("white", [1.0, 255.0])
def test_mit_push_file(tmp_path: Path, white: float) -> None:
    """The range of the images determines black and white; kloss_val uses its first 50 trajectories."""
    path = tmp_path / "kloss_val.hdf5"
    written = write(path, lambda rng, steps: {**(a := kloss(rng, steps)), "image": a["image"] * white / 255}, 53)
    with open_dataset(path) as data:
        assert data.task is TASKS["push-real"]
        assert len(data) == 50
        assert {s.split for s in data.summaries} == {"val"}
        expected, episode = written[7], data[7]
    np.testing.assert_array_equal(episode.states, expected["pos"][:, [0, 2]])
    np.testing.assert_array_equal(episode.observations["effector_position"][:, :2], expected["tip"][:, [0, 2]])
    np.testing.assert_array_equal(episode.observations["force"][:, :2], expected["force"][:, :2])
    np.testing.assert_array_equal(episode.observations["torque"][:, 2], expected["force"][:, 2])
    assert not episode.observations["torque"][:, :2].any()
    assert np.abs(episode.observations["image"] / 255 * white - expected["image"].mean(-1)).max() <= 0.51 * white / 255
    for key, shape in data.task.observations.items():
        assert episode.observations[key].shape == (len(episode), *shape)


def test_split_from_the_folder_name(tmp_path: Path) -> None:
    for folder in ("train", "test"):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / "kloss_train0.hdf5", kloss, 2)
    with open_dataset(tmp_path) as data:
        assert [s.split for s in data.summaries] == ["test", "test", "train", "train"]


def test_converted_files_have_the_same_hash(tmp_path: Path) -> None:
    """The step of 0.05 s is preserved."""
    write(tmp_path / "panda_door_push_10.hdf5", door, 3)
    with open_dataset(tmp_path / "panda_door_push_10.hdf5") as data:
        write_dataset(tmp_path / "converted.h5", data.task, data)
        with open_dataset(tmp_path / "converted.h5") as converted:
            assert converted.hash == data.hash
            assert converted[2].dt == 0.05


def without(key: str) -> Callable[[h5py.Group], None]:
    return lambda group: group.__delitem__(key)


def replaced(key: str, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[h5py.Group], None]:
    def edit(group: h5py.Group) -> None:
        array = change(group[key][()])
        del group[key]
        group[key] = array

    return edit


def not_finite(array: np.ndarray) -> np.ndarray:
    array[5, 1] = np.nan
    return array


BAD = [
    (
        without("ee-force-obs"),
        r"trajectory1 has no 'ee-force-obs'; expected the keys object-state, eef_pos, ee-force-obs",
    ),
    (without("object-state"), r"trajectory1 has no 'object-state'"),
    (replaced("eef_pos", not_finite), r"'eef_pos' of trajectory1 is nan at step 5, expected finite numbers"),
    (
        replaced("eef_pos", lambda a: a[:-2]),
        r"'eef_pos' of trajectory1 has 5 steps, 'object-state' has 7; expected the same",
    ),
    (
        replaced("image", lambda a: a[:, :32, :32]),
        r"'image' of trajectory1 has shape \(7, 32, 32\), expected \(7, 64, 64\)",
    ),
    (
        replaced("image", lambda a: a * 2),
        r"'image' of trajectory1 ranges from -1\.99\d* to 1\.99\d*, expected -1 \(black\) to 1",
    ),
    (
        replaced("contact-obs", lambda a: a[:, None]),
        r"'contact-obs' of trajectory1 has shape \(7, 1\), expected \(7,\)",
    ),
    (replaced("object-state", lambda a: a[:0]), r"'object-state' of trajectory1 has shape \(0, 5\), expected \(T, 5\)"),
    (replaced("eef_pos", lambda a: np.full(a.shape, b"x")), r"'eef_pos' of trajectory1 is .S1, expected numbers"),
]


@pytest.mark.parametrize(("edit", "message"), BAD)
def test_errors_name_the_cause_and_bad_trajectories_are_skipped(
    tmp_path: Path, edit: Callable[[h5py.Group], None], message: str
) -> None:
    path = tmp_path / "panda_door_pull_100.hdf5"
    write(path, door, 3)
    with open_dataset(path) as data:
        valid = [data[i].digest() for i in (0, 2)]
    with h5py.File(path, "r+") as file:
        edit(file["trajectory1"])
    mark_readable(path)
    with pytest.raises(BadInput, match=message) as error, open_dataset(path) as data:
        list(data)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)
    with open_dataset(path, skip_bad=True) as data:
        assert data.skipped == (str(error.value),)
        assert [episode.digest() for episode in data] == valid
        assert [s.index for s in data.summaries] == [0, 1]


def test_no_usable_trajectory(tmp_path: Path) -> None:
    path = tmp_path / "gentle_push_10.hdf5"
    write(path, push, 1)
    with h5py.File(path, "r+") as file:
        del file["trajectory0/contact"]
    with pytest.raises(BadInput, match=r"has no usable episode\. First error: .* has no 'contact'"):
        open_dataset(path, skip_bad=True)


def test_files_of_two_tasks(tmp_path: Path) -> None:
    write(tmp_path / "a.hdf5", door, 1)
    write(tmp_path / "b.hdf5", push, 1)
    with pytest.raises(BadInput, match=r"a\.hdf5 is of task 'door', .*b\.hdf5 of 'push': give files of one task"):
        open_dataset(tmp_path)


def test_invalid_file_in_the_folder(tmp_path: Path) -> None:
    write(tmp_path / "a.hdf5", door, 1)
    (tmp_path / "b.hdf5").write_bytes(b"")
    with pytest.raises(BadInput, match=r"b\.hdf5 is not an HDF5 file"):
        open_dataset(tmp_path)
    with h5py.File(tmp_path / "b.hdf5", "w") as file:
        file["trajectory0/numbers"] = np.arange(3)
    with pytest.raises(BadInput, match=r"b\.hdf5 has no episode of a known layout; expected the keys object-state/"):
        open_dataset(tmp_path)


@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.9])
def test_truncated_file(tmp_path: Path, fraction: float) -> None:
    path = tmp_path / "panda_door_pull_10.hdf5"
    write(path, door, 2)
    content = path.read_bytes()
    path.write_bytes(content[: int(fraction * len(content))])
    with pytest.raises(BadInput, match=r"is damaged or truncated|is not an HDF5 file"):
        open_dataset(path, skip_bad=True)
