"""The index of a data file gives the same episodes as the file, and is ignored when it does not belong to it."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import h5py
import pytest

from beliefscope.datasets import episode_index
from beliefscope.datasets.episode_index import index_path, read_index
from beliefscope.datasets.readers import hdf5_guard
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import EpisodeFile, open_dataset, sample_path, write_dataset

pytestmark = pytest.mark.slow


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    with open_dataset(sample_path("door")) as samples:
        episodes = [samples[index] for index in (0, 8, 9)]
    monkeypatch.setattr(episode_index, "EPISODES", 2)
    path = tmp_path / "set.h5"
    write_dataset(path, DOOR, episodes)
    return path


def contents(path: Path) -> object:
    with open_dataset(path) as data:
        return data.summaries, data.hash, data.held_out(), [episode.digest() for episode in data]


def test_index_of_a_written_file_equals_that_of_a_read_one(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written, indexed = index_path(path).read_bytes(), contents(path)
    index_path(path).unlink()
    assert contents(path) == indexed
    assert index_path(path).read_bytes() == written
    # With an index, neither the probe nor the attributes of the episodes are read.
    monkeypatch.setattr(hdf5_guard, "_readable", {})
    monkeypatch.setattr(hdf5_guard.subprocess, "run", lambda *_, **__: pytest.fail("probed"))
    monkeypatch.setattr(EpisodeFile, "_find_groups", lambda *_: pytest.fail("read"))
    assert contents(path) == indexed


def test_index_of_another_time_or_version_is_replaced(path: Path) -> None:
    indexed = contents(path)
    os.utime(path, ns=(1, 1))
    assert read_index(path) is None
    assert contents(path) == indexed
    assert read_index(path) is not None
    index_path(path).write_text(json.dumps(json.loads(index_path(path).read_text()) | {"version": 0}))
    assert contents(path) == indexed


def test_index_by_content_is_valid_at_any_time_and_only_for_the_content(path: Path) -> None:
    with open_dataset(path) as data:
        episode_index.write_index(path, data.summaries, data.hash, by_content=True)
    index = read_index(path)
    os.utime(path, ns=(1, 1))
    assert read_index(path) == index is not None
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    assert read_index(path) is None


@pytest.mark.first(2)
@pytest.mark.parametrize("task", ["door", "push", "door-field", "push-field"])
def test_included_files_have_an_index(task: str, tmp_path: Path) -> None:
    copied = tmp_path / "set.h5"
    copied.write_bytes(sample_path(task).read_bytes())
    with open_dataset(copied) as data:
        assert read_index(sample_path(task)) == (data.summaries, data.hash)


@pytest.mark.first(4)
@pytest.mark.parametrize(
    "change",
    [
        lambda d: d["columns"].pop("steps"),
        lambda d: d["columns"]["steps"].pop(),
        lambda d: d["columns"]["steps"].__setitem__(0, 0),
        lambda d: d["columns"]["split"].__setitem__(0, "other"),
        lambda d: d["columns"]["contact_fraction"].__setitem__(0, 2.0),
        lambda d: d["columns"].update({name: [] for name in episode_index.COLUMNS}),
        lambda d: d.__setitem__("hash", None),
        lambda d: d.__setitem__("file", [3]),
        lambda d: d.__setitem__("file", [*d["file"][:1], "0" * 64]),
        lambda d: d.__setitem__("columns", 3),
    ],
)
def test_damaged_index_is_ignored(path: Path, change: Callable[[dict[str, object]], object]) -> None:
    indexed = contents(path)
    document = json.loads(index_path(path).read_text())
    change(document)
    for text in (json.dumps(document), "{", ""):
        index_path(path).write_text(text)
        assert read_index(path) is None
        assert contents(path) == indexed


def test_changed_file_behind_an_index_is_reported(path: Path) -> None:
    times = path.stat().st_atime_ns, path.stat().st_mtime_ns
    with h5py.File(path, "r+") as file:
        file.move("trajectory1", "trajectory7")
    document = json.loads(index_path(path).read_text())
    os.utime(path, ns=times)
    index_path(path).write_text(json.dumps(document | {"file": [path.stat().st_size, times[1]]}))
    with open_dataset(path) as data, pytest.raises(ValueError, match="trajectory1 is not a group"):
        data[1]
