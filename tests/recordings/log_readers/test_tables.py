"""Replay buffers in Zarr and LeRobot data sets: columns over the steps of all episodes."""

from __future__ import annotations

import json
import shutil
import sys
import tomllib
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

import log_files as logs

from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.log_readers.column_map import read_map
from beliefscope.recordings.log_readers.columns import preview_columns, read_columns
from beliefscope.recordings.log_readers.guess import guess_map
from beliefscope.recordings.log_readers.read_log import read_log

ZARR = """
dt = 0.1
episode = "episode"
control = "action"
[state]
x = "state[0]"
y = "state[1]"
[sensors]
image = "camera"
pose = "obs/pose"
"""

LEROBOT = """
time = "timestamp"
episode = "episode_index"
control = "action"
[state]
x = "observation.state[0]"
y = "observation.state[1]"
[sensors]
top = "observation.images.top"
wrist = "observation.images.wrist"
"""


def map_file(folder: Path, text: str) -> Path:
    path = folder / "map.toml"
    path.write_text(text)
    return path


@pytest.fixture(params=[(2, "buffer.zarr"), (3, "buffer.zarr"), (2, "buffer.zarr.zip"), (3, "buffer.zip")])
def buffer(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    zarr_format, name = request.param
    logs.write_zarr(tmp_path / name, zarr_format)
    return tmp_path / name


@pytest.fixture
def lerobot(tmp_path: Path) -> Path:
    pytest.importorskip("av", reason="av is not installed: no video can be written")
    logs.write_lerobot(tmp_path / "dataset")
    return tmp_path / "dataset"


def test_episodes_of_a_replay_buffer(buffer: Path, tmp_path: Path) -> None:
    mapping = read_map(map_file(tmp_path, ZARR))
    episodes = read_log(read_columns(buffer, mapping), mapping, buffer.name)
    assert [len(e) for e in episodes] == [*logs.EPISODES]
    expected, at = logs.buffer_arrays(), slice(7, 11)
    assert np.array_equal(episodes[1].controls, expected["action"][at])
    np.testing.assert_allclose(episodes[1].states, expected["state"][at, :2], rtol=1e-6)
    assert np.array_equal(episodes[1].observations["image"], expected["camera"][at])
    np.testing.assert_allclose(episodes[1].observations["pose"], expected["obs/pose"][at], rtol=1e-6)


def test_only_columns_of_the_map_are_read(buffer: Path, tmp_path: Path) -> None:
    columns = read_columns(buffer, read_map(map_file(tmp_path, ZARR)))
    assert columns["img"].shape == (20, 4, 6, 3)
    assert columns["img"].strides == (0, 0, 0, 0)
    assert columns["camera"].any()


@pytest.mark.parametrize(("scale", "kind"), [(1.0, np.uint8), (255.0, np.float32)])
def test_floats_of_whole_levels_are_images(tmp_path: Path, scale: float, kind: type) -> None:
    """Other floats are arrays of numbers."""
    logs.write_zarr(tmp_path / "buffer.zarr")
    mapping = read_map(map_file(tmp_path, ZARR))
    images = logs.buffer_arrays()["camera"]
    columns = {**read_columns(tmp_path / "buffer.zarr", mapping), "camera": images.astype(np.float32) / scale}
    (episode, *_) = read_log(columns, mapping, "buffer")
    assert episode.observations["image"].dtype == kind
    assert episode.task.arrays == (() if kind is np.uint8 else ("image",))
    np.testing.assert_allclose(episode.observations["image"] * scale, images[:7], atol=1e-4)


def test_episodes_of_a_lerobot_data_set(lerobot: Path, tmp_path: Path) -> None:
    """Frames are those of the episode's part of its video; H.264 changes levels by a few units."""
    mapping = read_map(map_file(tmp_path, LEROBOT))
    episodes = read_log(read_columns(lerobot, mapping), mapping, lerobot.name)
    assert [len(e) for e in episodes] == [*logs.EPISODES]
    assert episodes[0].dt == pytest.approx(1.0 / logs.FPS)
    expected, at = logs.buffer_arrays(), slice(11, 20)
    np.testing.assert_allclose(episodes[2].states, expected["state"][at, :2], rtol=1e-6)
    assert np.array_equal(episodes[2].observations["wrist"], expected["camera"][at])
    for number, episode in enumerate(episodes):
        levels = [logs.level(number, frame) for frame in range(len(episode))]
        np.testing.assert_allclose(episode.observations["top"].mean(axis=(1, 2, 3)), levels, atol=2.0)


def test_guessed_maps_import_the_logs(buffer: Path, lerobot: Path, tmp_path: Path) -> None:
    for log, time in ((buffer, {"dt": 0.1}), (lerobot, {"time": "timestamp"})):
        text = guess_map(preview_columns(log), "log")
        values = tomllib.loads(text)
        assert values.items() >= (time | {"control": "action"}).items()
        mapping = read_map(map_file(tmp_path, text))
        assert len(read_log(read_columns(log, mapping), mapping, "log")) == 3


def test_videos_without_av_name_the_package(lerobot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(BadInput, match=r"need the package av: pip install 'beliefscope\[video\]', or leave the camera"):
        read_columns(lerobot, read_map(map_file(tmp_path, LEROBOT)))
    without = LEROBOT.replace('top = "observation.images.top"\n', "")
    assert read_columns(lerobot, read_map(map_file(tmp_path, without)))["action"].shape == (20, 2)


def test_missing_packages_are_named(buffer: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(BadInput, match=r"needs the package zarr: pip install 'beliefscope\[logs\]'"):
        read_columns(buffer)


def test_objects_are_refused(tmp_path: Path) -> None:
    """A type of objects, whose codec can be pickle, is refused before anything is decoded."""
    path = tmp_path / "buffer.zarr"
    logs.write_zarr(path, 2)
    for key, value in (("dtype", "|O"), ("filters", [{"id": "pickle"}])):
        file = path / "data" / "state" / ".zarray"
        original = file.read_text()
        file.write_text(json.dumps(json.loads(original) | {key: value}))
        with pytest.raises(BadInput, match=r"buffer\.zarr") as error:
            read_columns(path, read_map(map_file(tmp_path, ZARR)))
        assert "\n" not in str(error.value)
        file.write_text(original)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("codebase_version", "v2.1", "version 'v2.1', expected v3"),
        ("fps", 0, "fps in info.json is 0"),
        ("fps", "ten", "fps in info.json is 'ten', expected a number above 0"),
        ("fps", None, "fps in info.json is None, expected a number above 0"),
        ("features", {}, "column 'observation.images.top' of sensor top does not exist"),
        ("features", {"a": "b"}, "feature 'a' in info.json is 'b', expected a table with dtype and shape"),
        ("total_frames", 21, "data has 20 frames and info.json 21, expected the same"),
    ],
)
def test_wrong_metadata_of_lerobot(lerobot: Path, tmp_path: Path, key: str, value: object, message: str) -> None:
    info = lerobot / "meta" / "info.json"
    info.write_text(json.dumps(json.loads(info.read_text()) | {key: value}))
    mapping = read_map(map_file(tmp_path, LEROBOT))
    with pytest.raises(BadInput, match=message):
        read_log(read_columns(lerobot, mapping), mapping, "log")


@pytest.mark.parametrize("name", ["buffer.zarr", "buffer.zip"])
def test_short_chunks_of_blosc_are_refused(tmp_path: Path, name: str) -> None:
    """Blosc takes the length from the header of the chunk and would read beyond its end."""
    logs.write_zarr(tmp_path / "full.zarr", 2)
    chunk = tmp_path / "full.zarr" / "data" / "state" / "0.0"
    chunk.write_bytes(chunk.read_bytes()[:-20])
    if name.endswith("zip"):
        shutil.make_archive(str(tmp_path / "buffer"), "zip", tmp_path / "full.zarr")
    else:
        (tmp_path / "full.zarr").rename(tmp_path / name)
    with pytest.raises(BadInput, match=r"chunk data/state/0\.0 has \d+ bytes, and \d+ according to its header"):
        read_columns(tmp_path / name, read_map(map_file(tmp_path, ZARR)))


@pytest.mark.parametrize(("frames", "message"), [(8, "has no frame at 0.8 s"), (0, "does not exist")])
def test_short_videos_are_refused(lerobot: Path, tmp_path: Path, frames: int, message: str) -> None:
    video = lerobot / "videos" / "observation.images.top" / "chunk-000" / "file-001.mp4"
    video.unlink()
    if frames:
        logs.write_video(video, [0] * frames)
    with pytest.raises(BadInput, match=message):
        read_columns(lerobot, read_map(map_file(tmp_path, LEROBOT)))


OVERFLOWING = [7, 9 - 2**63, 20]


@pytest.mark.parametrize(
    ("ends", "message"),
    [([7, 5, 20], "ascending"), ([0, 20], "ascending"), (OVERFLOWING, "ascending"), ([7, 19], "ends at 19")],
)
def test_wrong_ends_of_episodes(tmp_path: Path, ends: list[int], message: str) -> None:
    import zarr

    logs.write_zarr(tmp_path / "buffer.zarr")
    meta = zarr.open_group(tmp_path / "buffer.zarr")["meta"]
    meta.create_array("episode_ends", data=np.array(ends), overwrite=True)
    with pytest.raises(BadInput, match=message):
        read_columns(tmp_path / "buffer.zarr")


def test_folders_of_other_formats_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"none of metadata\.yaml, meta/info\.json"):
        read_columns(tmp_path)


POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("meta/info.json", "", "meta/info.json is damaged: Expecting value"),
        ("meta/info.json", "[]", "codebase_version in info.json is None"),
        ("data/chunk-000/file-001.parquet", None, "data has 11 frames and info.json 20"),
        ("data/chunk-000/file-000.parquet", POINTER, "file-000.parquet is a pointer of Git LFS"),
        ("videos/observation.images.top/chunk-000/file-001.mp4", POINTER, "file-001.mp4 is a pointer of Git LFS"),
        ("videos/observation.images.top/chunk-000/file-001.mp4", None, "file-001.mp4 does not exist"),
    ],
)
def test_missing_files_of_lerobot(lerobot: Path, tmp_path: Path, file: str, content: str | None, message: str) -> None:
    (lerobot / file).unlink()
    if content is not None:
        (lerobot / file).write_text(content)
    with pytest.raises(BadInput, match=message):
        read_columns(lerobot, read_map(map_file(tmp_path, LEROBOT)))


@pytest.mark.parametrize(
    ("column", "change", "message"),
    [
        ("timestamp", None, "has other columns than the first file: timestamp: float"),
        ("timestamp", lambda values: [None] * len(values), "timestamp of episode 0 is nan at step 0, expected finite"),
        (
            "timestamp",
            lambda values: [0.0] * len(values),
            "timestamp of episode 0 is 0 s at step 1, after 0 s; expected",
        ),
    ],
    ids=["missing", "empty", "constant"],
)
def test_damaged_tables_of_lerobot(
    lerobot: Path, tmp_path: Path, column: str, change: Callable[[Any], list[Any]] | None, message: str
) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    path = lerobot / "data" / "chunk-000" / "file-000.parquet"
    table = parquet.read_table(path)
    place, kind = table.column_names.index(column), table.schema.field(column).type
    changed = table.drop([column])
    if change is not None:
        changed = table.set_column(place, column, pa.array(change(table.column(column)), kind))
    parquet.write_table(changed, path)
    with pytest.raises(BadInput, match=message):
        read_columns(lerobot, read_map(map_file(tmp_path, LEROBOT)))


def test_archives_that_are_no_replay_buffers(tmp_path: Path) -> None:
    path, copy = tmp_path / "buffer.zip", tmp_path / "copy.zip"
    logs.write_zarr(path)
    copy.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(BadInput, match=r"copy\.zip is not a complete zip archive"):
        read_columns(copy)
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(copy, "w") as target:
        for name in source.namelist():
            target.writestr(f"folder/{name}", source.read(name))
    with pytest.raises(BadInput, match=r"no array 'meta/episode_ends'.* in the folder 'folder', expected at the top"):
        read_columns(copy)


TABLE = """
time = "t"
[state]
x = "x"
[sensors]
camera = "image"
"""


def write_tables(folder: Path, starts: dict[str, float]) -> None:
    """A file of three steps per name, whose state begins at the value."""
    folder.mkdir()
    for name, start in starts.items():
        rows = {"t": 7.0 + 0.1 * np.arange(3), "x": start + np.arange(3), "image": np.full((3, 4, 4), start, np.uint8)}
        np.savez(folder / name, **rows)


def test_files_of_a_folder_are_episodes(tmp_path: Path) -> None:
    write_tables(tmp_path / "runs", {"run_10.npz": 10.0, "run_9.npz": 9.0})
    mapping = read_map(map_file(tmp_path, TABLE))
    episodes = read_log(read_columns(tmp_path / "runs", mapping), mapping, "runs")
    assert [e.provenance["episode"] for e in episodes] == ["run_9", "run_10"]
    assert [e.states[:, 0].tolist() for e in episodes] == [[9.0, 10.0, 11.0], [10.0, 11.0, 12.0]]
    assert [e.observations["camera"].shape for e in episodes] == [(3, 4, 4)] * 2
    assert {e.dt for e in episodes} == {0.1}, "not 0.0999999999999996, the difference of two times"
    assert 'time = "t"' in guess_map(preview_columns(tmp_path / "runs"), "runs")


def test_csv_files_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    for name in "ab":
        (tmp_path / "runs" / f"{name}.csv").write_text("t,x\n0,1\n0.1,2\n")
    mapping = read_map(map_file(tmp_path, 'time = "t"\n[state]\nx = "x"\n[sensors]\npose = "x"\n'))
    assert len(read_log(read_columns(tmp_path / "runs", mapping), mapping, "runs")) == 2


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ({"t": [0.0, 0.1]}, r"run_2\.npz has no column 'x', which other files of runs have"),
        ({"t": [0.0, 0.1], "x": [1.0]}, r"run_2\.npz has 1 row of 'x', but 2 of 't'"),
        ({"t": [0.0], "x": [["1"]]}, r"column 'x' has rows of shape \(1,\) in run_2\.npz and \(\) in run_1\.npz"),
        ({"t": [0.0], "x": ["a"]}, r"column 'x' has text in run_2\.npz and numbers in run_1\.npz"),
    ],
)
def test_different_files_of_a_folder(tmp_path: Path, rows: dict[str, Any], message: str) -> None:
    write_tables(tmp_path / "runs", {"run_1.npz": 1.0})
    np.savez(tmp_path / "runs" / "run_2.npz", **rows)
    mapping = read_map(map_file(tmp_path, TABLE.replace("image", "x")))
    with pytest.raises(BadInput, match=message):
        read_columns(tmp_path / "runs", mapping)


def test_formats_of_a_folder_are_not_mixed(tmp_path: Path) -> None:
    write_tables(tmp_path / "runs", {"run_1.npz": 1.0})
    (tmp_path / "runs" / "run_2.csv").write_text("t,x\n0,1\n")
    with pytest.raises(BadInput, match=r"folder runs has files \.csv and \.npz, expected one format"):
        read_columns(tmp_path / "runs")


def test_guessed_map_has_square_images(tmp_path: Path) -> None:
    """They have the shape of covariances, of which there are none without an estimate."""
    arrays = {"t": np.arange(3.0), "camera": np.zeros((3, 4, 4), np.uint8), "depth": np.zeros((3, 4, 4))}
    np.savez(tmp_path / "log.npz", **arrays, sigma_x=np.zeros(3))
    text = guess_map(preview_columns(tmp_path / "log.npz"), "log")
    assert tomllib.loads(text)["sensors"].keys() == {"camera", "depth", "sigma_x"}
    np.savez(tmp_path / "log.npz", **arrays, est_x=np.zeros(3))
    assert tomllib.loads(guess_map(preview_columns(tmp_path / "log.npz"), "log"))["sensors"].keys() == {"camera"}


def test_stacked_episodes_are_explained(tmp_path: Path) -> None:
    np.savez(tmp_path / "log.npz", x=np.zeros((5, 30)), t=np.zeros((5, 30)))
    mapping = read_map(map_file(tmp_path, TABLE.replace("image", "x")))
    with pytest.raises(BadInput, match=r"shape \(5, 30\), expected \(5, 1\): a row is a step.* numbers the episodes"):
        read_log(read_columns(tmp_path / "log.npz", mapping), mapping, "log.npz")


def test_errors_list_few_of_many_columns(tmp_path: Path) -> None:
    np.savez(tmp_path / "log.npz", **{f"pixel_{i}": np.zeros(2) for i in range(500)})
    mapping = read_map(map_file(tmp_path, 'dt = 0.1\n[state]\nx = "pixel"\n[sensors]\npose = "pixel_1"\n'))
    with pytest.raises(
        BadInput, match=r"column 'pixel' of .* does not exist.*Available: pixel_0, .*pixel_59 and 440 more\.$"
    ):
        read_log(read_columns(tmp_path / "log.npz", mapping), mapping, "log.npz")
