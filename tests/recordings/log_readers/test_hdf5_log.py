"""Logs in HDF5: a file per episode, or a group per episode, with names of the user's own."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.log_readers.column_map import read_map
from beliefscope.recordings.log_readers.columns import preview_columns, read_columns
from beliefscope.recordings.log_readers.guess import guess_map
from beliefscope.recordings.log_readers.read_log import read_log

MAP = """
time = "stamp"
control = "action/delta"
contact = "in_contact"
[state]
x = "gt/pose[0]"
yaw = {column = "gt/pose[2]", unit = "rad"}
[sensors]
camera = "obs/wrist"
"""


def write_episode(group: h5py.Group, start: float) -> None:
    """Three steps of times since 1970, and text, which is no column."""
    group["gt/pose"] = start + np.arange(9.0).reshape(3, 3)
    group["action/delta"] = np.zeros((3, 2))
    group["obs/wrist"] = np.full((3, 4, 4), start, np.uint8)
    group["in_contact"] = np.array([False, True, True])
    group["stamp"] = 1.7e9 + start + 0.05 * np.arange(3)
    group["notes"] = "unused"


def map_of(folder: Path, text: str = MAP) -> Path:
    path = folder / "map.toml"
    path.write_text(text)
    return path


@pytest.mark.slow
def test_files_of_a_folder_are_episodes(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    for number in range(10):
        with h5py.File(logs / f"run_{number}.hdf5", "w") as file:
            write_episode(file, float(number))
    mapping = read_map(map_of(tmp_path))
    episodes = read_log(read_columns(logs, mapping), mapping, "logs", "auto")
    assert [episode.split for episode in episodes] == ["train"] * 8 + ["val", "test"]
    assert episodes[3].states[:, 0].tolist() == [3.0, 6.0, 9.0]
    assert episodes[3].contact.tolist() == [False, True, True]
    assert {episode.dt for episode in episodes} == {0.05}, "times since 1970 have 0.2 us"
    with pytest.raises(BadInput, match="logs has 2 episodes; --split auto needs 10"):
        read_log({n: c[:6] for n, c in read_columns(logs, mapping).items()}, mapping, "logs", "auto")


@pytest.mark.slow
@pytest.mark.parametrize("prefix", ["", "data/"])
def test_groups_of_a_file_are_episodes(tmp_path: Path, prefix: str) -> None:
    with h5py.File(tmp_path / "demos.h5", "w") as file:
        for number in (10, 9):
            write_episode(file.create_group(f"{prefix}demo_{number}"), float(number))
    mapping = read_map(map_of(tmp_path, 'episode = "episode"\n' + MAP))
    episodes = read_log(read_columns(tmp_path / "demos.h5", mapping), mapping, "demos.h5")
    assert [episode.provenance["episode"] for episode in episodes] == ["demo_9", "demo_10"]
    with h5py.File(tmp_path / "demos.h5", "a") as file:
        del file[f"{prefix}demo_10/stamp"]
    with pytest.raises(BadInput, match=f"no array {prefix}demo_10/stamp, which other episodes have"):
        read_columns(tmp_path / "demos.h5", mapping)


@pytest.mark.slow
def test_a_first_map(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "run.h5", "w") as file:
        write_episode(file, 1.0)
    text = guess_map(preview_columns(tmp_path / "run.h5"), "run")
    for line in ('time = "stamp"', 'control = "action/delta"', 'contact = "in_contact"', 'y = "gt/pose[1]"'):
        assert line in text
    assert 'yaw = {column = "gt/pose[2]", unit = "rad"}' in text
    mapping = read_map(map_of(tmp_path, text))
    (episode,) = read_log(read_columns(tmp_path / "run.h5", mapping), mapping, "run")
    assert episode.observations["obs_wrist"].shape == (3, 4, 4)


def test_data_sets_are_no_logs() -> None:
    with pytest.raises(BadInput, match=r"door\.h5 is a data set already: pass it as --data"):
        preview_columns(Path("datasets/samples/door.h5"))


@pytest.mark.parametrize(("span", "unit"), [(0.04, "mm"), (0.4, "cm"), (40.0, "m")])
def test_units_for_display_follow_the_span_of_the_positions(tmp_path: Path, span: float, unit: str) -> None:
    columns = {"t": np.arange(3.0), "x": span * np.array([0.0, 0.5, 1.0]), "z": np.zeros(3)}
    mapping = read_map(map_of(tmp_path, 'time = "t"\n[state]\nx = "x"\n[sensors]\nz = "z"\n'))
    (episode,) = read_log(columns, mapping, "log")
    assert episode.task.components[0].conversion[0] == unit
