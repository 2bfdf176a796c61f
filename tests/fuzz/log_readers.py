"""Readers of logs of other programs under test: the whole import, to a data set and a trace."""

from __future__ import annotations

import shutil
import sys
import tomllib
from functools import cache, partial
from pathlib import Path
from random import Random
from unittest import mock

import mutate
import numpy as np
from reader import Reader, check_serializable

sys.path.insert(0, str(Path(__file__).parents[1] / "recordings" / "log_readers"))

import log_files

from beliefscope.datasets.store import open_dataset, write_dataset
from beliefscope.inspect.trace import load_trace, save_trace
from beliefscope.recordings.log_readers import rerun_file
from beliefscope.recordings.log_readers.column_map import ColumnMap, read_map
from beliefscope.recordings.log_readers.columns import preview_columns, read_columns
from beliefscope.recordings.log_readers.guess import guess_map
from beliefscope.recordings.log_readers.read_log import read_log, recorded_trace
from beliefscope.recordings.probe import RecordingInfo

SECONDS = 0.4
"""Length of the logs."""

POSE = """
dt = 0.05
[state]
x = "/truth.pose.pose.position.x"
y = "/truth.pose.pose.position.y"
yaw = {column = "/truth.pose.pose.orientation", unit = "quaternion_yaw"}
[sensors]
gyro = "/imu.angular_velocity"
image = "/camera.data"
front = "/preview.data"
[covariates]
frame = "/odom.child_frame_id"
age = {column = "/odom.age", cuts = [0.02]}
[estimate]
mean = ["/odom.pose.pose.position.x", "/odom.pose.pose.position.y", "/odom.pose.pose.orientation"]
covariance = "/odom.pose.covariance[0,1,5,6,7,11,30,31,35]"
"""
RERUN = """
dt = 0.05
time = "sim"
[state]
x = "/truth.translation[0]"
y = "/truth.translation[1]"
[sensors]
gyro = "/imu"
matrix = "/matrix"
image = "/camera"
front = "/preview.blob"
[estimate]
mean = ["/odom.translation[0]", "/odom.translation[1]"]
"""
ZARR = """
dt = 0.1
episode = "episode"
control = "action"
[state]
x = "state[0]"
y = "state[1]"
[sensors]
image = "camera"
float_image = "img"
[estimate]
mean = "action"
"""
LEROBOT = """
time = "timestamp"
episode = "episode_index"
[state]
x = "observation.state[0]"
y = "observation.state[1]"
[sensors]
top = "observation.images.top"
wrist = "observation.images.wrist"
[estimate]
mean = "action"
"""


@cache
def mapping(text: str) -> ColumnMap:
    path = Path(log_files.__file__).with_name(f".map-{len(text)}.toml")
    path.write_text(text)
    try:
        return read_map(path)
    finally:
        path.unlink()


def read(text: str, path: Path) -> None:
    """Preview and import. Nothing but the complete outputs may remain."""
    with mock.patch.object(rerun_file.RecordingProbe, "__call__", return_value=RecordingInfo("other")):
        tomllib.loads(guess_map(preview_columns(path), path.stem))
        columns = read_columns(path, mapping(text))
    episodes = read_log(columns, mapping(text), path.name)
    data, run = path.with_suffix(".h5"), path.with_suffix(".trace")
    try:
        if all(np.isfinite(e.states).all() for e in episodes):
            write_dataset(data, episodes[0].task, episodes)
            with open_dataset(data) as stored:
                assert len(stored[0]) == len(episodes[0])
        save_trace(recorded_trace(columns, mapping(text), episodes, 0, path.name), run)
        check_serializable(dict(load_trace(run).settings))
    finally:
        assert not list(path.parent.glob(".*.part"))


def write(writer: partial[None], path: Path) -> None:
    """Write a short log."""
    with mock.patch.object(log_files, "SECONDS", SECONDS):
        writer(path)


def corrupt(path: Path, rng: Random) -> None:
    """Corrupt a file, or one of the files of a folder: its JSON document, its bytes, or whether it exists."""
    files = sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
    file = rng.choice(files)
    if path.is_dir() and rng.random() < 0.1:
        file.unlink()
        if rng.random() < 0.5 and len(files) > 1:
            shutil.copy(rng.choice([other for other in files if other != file]), file)
        return
    data = file.read_bytes()
    is_document = data.startswith(b"{") and rng.random() < 0.8
    file.write_bytes((mutate.corrupt_json if is_document else mutate.corrupt_bytes)(data, rng))


def _reader(text: str, suffix: str, writer: partial[None]) -> Reader:
    return Reader(partial(write, writer), corrupt, partial(read, text), suffix)


LOG_READERS = {
    "log-mcap-json": _reader(POSE, ".mcap", partial(log_files.write_json_mcap, plain=True)),
    "log-mcap-ros2": _reader(POSE, ".mcap", partial(log_files.write_ros_mcap, plain=True)),
    "log-mcap-zstd": _reader(POSE, ".mcap", partial(log_files.write_ros_mcap)),
    "log-bag-sqlite3": _reader(POSE, ".bag", partial(log_files.write_bag)),
    "log-bag-mcap": _reader(POSE, ".bag", partial(log_files.write_bag, storage="MCAP")),
    "log-zarr2": _reader(ZARR, ".zarr", partial(log_files.write_zarr, zarr_format=2)),
    "log-zarr3": _reader(ZARR, ".zarr", partial(log_files.write_zarr, zarr_format=3)),
    "log-zarr-zip": _reader(ZARR, ".zip", partial(log_files.write_zarr, zarr_format=3)),
    "log-lerobot": _reader(LEROBOT, ".lerobot", partial(log_files.write_lerobot)),
    "log-rerun": _reader(RERUN, ".rrd", partial(log_files.write_rerun)),
}
"""Readers by name. MCAP without compression and checksums, so that messages are corrupted as well."""
