"""Dataset files: round trips, atomic writes, and error messages for invalid files."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.readers import hdf5_guard
from beliefscope.datasets.readers.hdf5_guard import mark_readable, probe
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset

pytestmark = pytest.mark.slow

STEPS = 7


def random_episode(seed: int = 0, split: str = "train") -> Episode:
    rng = np.random.default_rng(seed)

    def floats(*shape: int) -> np.ndarray:
        return rng.normal(size=(STEPS, *shape)).astype(np.float32)

    contact = rng.random(STEPS) < 0.5
    return Episode(
        task=DOOR,
        states=floats(3),
        controls=floats(7),
        observations={
            "image": rng.integers(0, 256, (STEPS, 32, 32), np.uint8),
            "effector_position": floats(3),
            "force": floats(3),
            "torque": floats(3),
            "contact": contact[:, None].astype(np.float32),
        },
        contact=contact,
        qpos=floats(10),
        dt=0.1,
        seed=seed,
        split=split,
        provenance={"policy": "pull", "hinge": [0.8, -0.3], "note": "é"},
    )


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "set.h5"
    write_dataset(path, DOOR, [random_episode(0), random_episode(1, "val")])
    return path


def test_round_trip_is_exact(path: Path) -> None:
    with open_dataset(path) as data:
        assert len(data) == 2
        assert data.task is DOOR
        for i, split in enumerate(("train", "val")):
            original, read = random_episode(i, split), data[i]
            assert read.digest() == original.digest()
            assert read.provenance == original.provenance
            np.testing.assert_array_equal(read.observations["image"], original.observations["image"])
            assert read.contact.dtype == bool
        summary = data.summaries[1]
    assert (summary.index, summary.steps, summary.policy, summary.split, summary.seed) == (1, STEPS, "pull", "val", 1)
    assert summary.contact_fraction == pytest.approx(random_episode(1).contact.mean())


def test_same_episodes_give_the_same_bytes_and_hash(path: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.h5"
    write_dataset(copy, DOOR, [random_episode(0), random_episode(1, "val")])
    assert copy.read_bytes() == path.read_bytes()
    with open_dataset(copy) as a, open_dataset(path) as b:
        assert a.hash == b.hash
    write_dataset(copy, DOOR, [random_episode(0), random_episode(2, "val")])
    with open_dataset(copy) as a, open_dataset(path) as b:
        assert a.hash != b.hash


def test_arrays_are_plain_hdf5(path: Path) -> None:
    with h5py.File(path) as file:
        image = file["trajectory0/observations/image"][()]
        assert image.shape == (STEPS, 32, 32)
        assert file["trajectory0"].attrs["split"] == "train"


def test_failed_write_keeps_the_previous_file(path: Path) -> None:
    before = path.read_bytes()

    def failing() -> Iterator[Episode]:
        yield random_episode(5)
        raise RuntimeError("simulator error")

    with pytest.raises(RuntimeError, match="simulator error"):
        write_dataset(path, DOOR, failing())
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_write_to_a_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"Folder .*missing does not exist: cannot write a\.h5 there"):
        write_dataset(tmp_path / "missing" / "a.h5", DOOR, [random_episode()])


def check_rejected(path: Path, message: str) -> None:
    with pytest.raises(BadInput, match=message) as error, open_dataset(path) as data:
        list(data)
    assert "\n" not in str(error.value)
    assert path.name in str(error.value)


def test_missing_file(tmp_path: Path) -> None:
    check_rejected(tmp_path / "no.h5", "does not exist")


def test_empty_folder(tmp_path: Path) -> None:
    check_rejected(
        tmp_path, r"has no data: expected a data file, or a folder of files that end in \.json, \.h5 or \.hdf5"
    )


def test_the_data_files_of_a_folder_are_named(path: Path) -> None:
    folder = path.parent
    (folder / "study.json").write_text("{}")
    check_rejected(folder, rf"is a folder: give one of its data files, {path.name}\.")
    (folder / "more").mkdir()
    for i in range(6):
        (folder / "more" / f"{i}.h5").write_bytes(path.read_bytes())
    check_rejected(folder, r"data files, .*more/4\.h5 and 2 more\.")


@pytest.mark.skipif(os.geteuid() == 0, reason="root can read all files")
def test_file_without_permission(path: Path) -> None:
    path.chmod(0)
    check_rejected(path, "No permission")


@pytest.mark.parametrize("content", [b"", b"hello", b"\x89HDF\r\n\x1a", bytes(5000)])
def test_not_hdf5(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.h5"
    path.write_bytes(content)
    check_rejected(path, "is not an HDF5 file")


@pytest.mark.parametrize("fraction", [0.01, 0.2, 0.5, 0.9, 0.999])
def test_truncated_file(path: Path, fraction: float) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(fraction * len(content))])
    check_rejected(path, "damaged or truncated|is not an HDF5 file")


def test_flipped_bytes_are_detected_or_harmless(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A damaged byte never gives wrong numbers or an exception other than BadInput."""
    content = path.read_bytes()
    expected = [random_episode(0).digest(), random_episode(1, "val").digest()]
    rng = np.random.default_rng(0)
    detected, endless, files = 0, 0, []
    for at in rng.integers(0, len(content), 100):
        damaged = bytearray(content)
        damaged[at] ^= 0xFF
        files.append(path.with_name(f"{at}.h5"))
        files[-1].write_bytes(damaged)
    monkeypatch.setattr(hdf5_guard, "SECONDS", 0.5)
    probe(files)  # in one process
    for file in files:
        try:
            with open_dataset(file) as data:
                assert [e.digest() for e in data] == expected
        except BadInput as error:
            detected += 1
            endless += "cannot be read as HDF5 within" in str(error)
    assert detected > 50
    assert endless < 5, "libhdf5 survives nearly all files"


Edit = Callable[[h5py.File], None]


def edit_file(path: Path, edit: Edit) -> None:
    """Edit a file with h5py, which keeps it valid HDF5: it needs no probe."""
    with h5py.File(path, "r+") as file:
        edit(file)
    mark_readable(path)


def without(name: str) -> Edit:
    return lambda file: file.__delitem__(name)


def replaced(name: str, array: np.ndarray) -> Edit:
    def edit(file: h5py.File) -> None:
        del file[name]
        file[name] = array

    return edit


def attribute(name: str, key: str, value: object) -> Edit:
    return lambda file: file[name].attrs.__setitem__(key, value)


def no_attribute(name: str, key: str) -> Edit:
    return lambda file: file[name].attrs.__delitem__(key)


def changed_pixel(file: h5py.File) -> None:
    image = file["trajectory1/observations/image"][()]
    image[3, 4, 5] += 1
    file["trajectory1/observations/image"][...] = image


def with_nan(shape: tuple[int, ...]) -> np.ndarray:
    array = np.zeros(shape, np.float32)
    array[3] = np.nan
    return array


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (no_attribute("/", "format"), r"not a data set: its attribute 'format' is None, expected 'beliefscope-"),
        (attribute("/", "format", 3), "not a data set"),
        (attribute("/", "version", 9), "version 9 of the layout; this release reads version 1"),
        (attribute("/", "definition", "{"), "attribute 'definition' is not the JSON of a task: Expecting property"),
        (attribute("/", "definition", "{}"), "incomplete definition of a task: KeyError: 'name'"),
        (lambda f: [f.__delitem__(k) for k in list(f)], "has no episode"),
        (without("trajectory0"), r"has 1 episode, but no group 'trajectory0'"),
        (replaced("trajectory1", np.zeros(3)), "no group 'trajectory1'"),
        (without("trajectory1/states"), r"trajectory1 has no 'states'\. It has: contact, controls"),
        (without("trajectory1/observations/force"), "trajectory1 has no 'observations/force'"),
        (without("trajectory1/observations"), "trajectory1 has no 'observations/image'"),
        (no_attribute("trajectory0", "digest"), "trajectory0 has no attribute 'digest'"),
        (no_attribute("trajectory0", "split"), "trajectory0 has no attribute 'split'"),
        (attribute("trajectory0", "split", "exam"), r"'split' of trajectory0 is 'exam'\. Available: train, val, test"),
        (attribute("trajectory0", "seed", "x"), "'seed' of trajectory0 is 'x', expected int"),
        (attribute("trajectory0", "dt", 0.05), r"'dt' of trajectory0 is 0\.05 s; task 'door' has steps of 0\.1 s"),
        (attribute("trajectory0", "provenance", "{"), "'provenance' of trajectory0 is not a JSON object"),
        (attribute("trajectory0", "provenance", "[]"), "'provenance' of trajectory0 is not a JSON object"),
        (replaced("trajectory0/states", np.zeros((0, 3), np.float32)), "expected at least one step"),
        (replaced("trajectory0/states", np.float32(1)), "expected at least one step"),
        (
            replaced("trajectory0/states", np.zeros((STEPS, 4), np.float32)),
            rf"'states' of trajectory0 has shape \({STEPS}, 4\), expected \({STEPS}, 3\)",
        ),
        (
            replaced("trajectory0/observations/image", np.zeros((STEPS, 64, 64), np.uint8)),
            rf"'observations/image' of trajectory0 has shape \({STEPS}, 64, 64\), expected \({STEPS}, 32, 32\)",
        ),
        (
            replaced("trajectory0/observations/force", np.zeros((STEPS - 1, 3), np.float32)),
            rf"'observations/force' of trajectory0 has shape \({STEPS - 1}, 3\)",
        ),
        (replaced("trajectory0/qpos", np.zeros(STEPS, np.float32)), rf"'qpos' .* expected \({STEPS}, any\)"),
        (
            replaced("trajectory0/controls", np.zeros((STEPS, 7))),
            "'controls' of trajectory0 is float64, expected float32",
        ),
        (
            replaced("trajectory0/observations/torque", with_nan((STEPS, 3))),
            r"'observations/torque' of trajectory0 is nan at step 3, expected finite numbers",
        ),
        (changed_pixel, "the arrays of trajectory1 do not match its digest"),
        (attribute("trajectory1", "split", "test"), "the arrays of trajectory1 do not match its digest"),
    ],
)
def test_errors_name_the_cause(path: Path, edit: Edit, message: str) -> None:
    edit_file(path, edit)
    check_rejected(path, message)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (without("trajectory0/states"), r"trajectory0 has no 'states'"),
        (replaced("trajectory0", np.zeros(3)), "trajectory0 is not a group"),
        (attribute("trajectory0", "dt", 0.05), r"'dt' of trajectory0 is 0\.05 s"),
        (replaced("trajectory0/observations/torque", with_nan((STEPS, 3))), r"is nan at step 3"),
        (attribute("trajectory0", "split", "val"), "the arrays of trajectory0 do not match its digest"),
    ],
)
def test_unusable_trajectories_are_skipped(path: Path, edit: Edit, message: str) -> None:
    edit_file(path, edit)
    with open_dataset(path, skip_bad=True) as data:
        (line,) = data.skipped
        assert re.search(message, line)
        assert str(path) in line
        assert [episode.digest() for episode in data] == [random_episode(1, "val").digest()]
        assert [(s.index, s.split) for s in data.summaries] == [(0, "val")]
    edit_file(path, without("trajectory1/controls"))
    with pytest.raises(BadInput, match=r"has no usable episode\. First error: "):
        open_dataset(path, skip_bad=True)


def test_external_hdf5_file_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "external.h5"
    with h5py.File(path, "w") as file:
        file["trajectory0/object-state"] = np.zeros((5, 5), np.float32)
    check_rejected(path, "is an HDF5 file, but not a data set")


def test_a_log_in_another_format_is_imported_first(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("t,x\n0,1\n")
    check_rejected(tmp_path / "log.csv", "is not an HDF5 file; beliefscope import reads logs in other formats")


@pytest.mark.parametrize("index", [-1, 2])
def test_unknown_episode(path: Path, index: int) -> None:
    with open_dataset(path) as data, pytest.raises(BadInput, match=f"Episode {index} is not in .* 0 to 1"):
        data[index]
    with open_dataset(path) as data, pytest.raises(BadInput, match=f"Episode {index} is not in .* 0 to 1"):
        data.in_parts(index)


def test_an_inconsistent_task_is_refused_before_its_episodes_are_written(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="dt is 0 s"):
        write_dataset(tmp_path / "set.h5", replace(DOOR, dt=0), [random_episode()])
    assert not list(tmp_path.iterdir())


def test_unknown_task() -> None:
    with pytest.raises(BadInput, match=r"task 'drawer' does not exist\. Available: door"):
        sample_path("drawer")


def test_file_is_closed_after_use(path: Path) -> None:
    with open_dataset(path) as data:
        episode = data[0]
    assert len(episode) == STEPS
    with h5py.File(path, "r+"):
        pass  # fails while the file is open for reading
