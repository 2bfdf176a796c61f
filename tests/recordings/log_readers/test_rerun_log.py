"""Rerun recordings of other programs: entities are topics on a timeline."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import rerun as rr

sys.path.insert(0, str(Path(__file__).parent))

import log_files as logs

from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.log_readers.column_map import read_map
from beliefscope.recordings.log_readers.columns import preview_columns, read_columns
from beliefscope.recordings.log_readers.guess import guess_map
from beliefscope.recordings.log_readers.read_log import read_log, recorded_trace

pytestmark = pytest.mark.slow  # a process reads each recording first

MAP = """
dt = 0.05
time = "sim"
[state]
x = "/truth.translation[0]"
y = "/truth.translation[1]"
yaw = {column = "/truth.quaternion", unit = "quaternion_yaw"}
[sensors]
gyro = "/imu"
turn = "/turn"
matrix = "/matrix"
image = "/camera"
front = "/preview.blob"
depth = "/depth.buffer"
[covariates]
stage = "/stage"
[estimate]
mean = ["/odom.translation[0]", "/odom.translation[1]", "/odom.quaternion"]
"""


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "log.rrd"
    logs.write_rerun(path)
    return path


def map_file(folder: Path, text: str = MAP) -> Path:
    path = folder / "map.toml"
    path.write_text(text)
    return path


def test_entities_on_a_timeline(log: Path, tmp_path: Path) -> None:
    mapping = read_map(map_file(tmp_path))
    columns = read_columns(log, mapping)
    (episode,) = read_log(columns, mapping, log.name)
    ticks = np.arange(0.35, 2.0 + 1e-9, 0.05)
    np.testing.assert_allclose(episode.states, [logs.pose(t) for t in logs.held("/truth", ticks)], atol=1e-6)
    spins = np.array([logs.spin(t) for t in logs.held("/imu", ticks)])
    np.testing.assert_allclose(episode.observations["gyro"], spins, atol=1e-6)
    np.testing.assert_allclose(episode.observations["turn"], spins[:, 1:2], atol=1e-6)
    np.testing.assert_allclose(episode.observations["matrix"][:, 0], spins, atol=1e-6)
    assert episode.task.arrays == ("matrix", "depth")
    images = [logs.colour(t) for t in logs.held("/camera", ticks)]
    assert np.array_equal(episode.observations["image"], images)
    images = [logs.colour(t) for t in logs.held("/preview", ticks)]
    assert np.array_equal(episode.observations["front"], images)
    assert episode.observations["depth"].shape == (len(ticks), 4, 6)
    depths = episode.observations["depth"][:, 0, 0]
    np.testing.assert_allclose(depths, 1000 * logs.held("/camera", ticks), atol=1.0)
    assert set(columns["/stage"]) == {"", "reach", "lift"}
    trace = recorded_trace(columns, mapping, [episode], 0, log.name)
    np.testing.assert_allclose(trace.estimate_mean, [logs.pose(t) for t in logs.held("/odom", ticks)], atol=1e-6)


def test_a_sequence_has_a_step_per_number(tmp_path: Path) -> None:
    """A timeline of numbers: columns of 10 numbers, every other one of y."""
    recording = rr.RecordingStream("other", recording_id="numbers")
    recording.save(tmp_path / "log.rrd")
    for name, numbers in (("x", np.arange(10)), ("y", np.arange(0, 10, 2))):
        times = [rr.TimeColumn("frame", sequence=numbers)]
        recording.send_columns(name, times, rr.Scalars.columns(scalars=0.5 * numbers))
    recording.disconnect()
    mapping = read_map(map_file(tmp_path, 'dt = 0.1\n[state]\nx = "/x"\ny = "/y"\n'))
    columns = read_columns(tmp_path / "log.rrd", mapping)
    assert columns["/x"].tolist() == (0.5 * np.arange(9)).tolist()
    assert columns["/y"].tolist() == [0.0, 0.0, 1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 4.0]
    assert read_log(columns, mapping, "log")[0].dt == 0.1


def test_a_guessed_map_imports_the_recording(tmp_path: Path) -> None:
    recording = rr.RecordingStream("other", recording_id="guess")
    recording.save(tmp_path / "log.rrd")
    for step in range(20):
        recording.set_time("t", duration=0.1 * step)
        for name in ("truth", "odom"):
            recording.log(name, rr.Transform3D(translation=[step, 0, 0], rotation=rr.Quaternion(xyzw=[0, 0, 0, 1])))
        recording.log("gyro", rr.Scalars([1.0, 2.0]))
    recording.disconnect()
    text = guess_map(preview_columns(tmp_path / "log.rrd"), "log")
    values = tomllib.loads(text)
    assert values["dt"] == pytest.approx(0.1)
    assert values["sensors"] == {"gyro": "/gyro"}
    assert values["estimate"]["mean"][2] == "/odom.quaternion"
    mapping = read_map(map_file(tmp_path, text))
    (episode,) = read_log(read_columns(tmp_path / "log.rrd", mapping), mapping, "log")
    assert episode.states[:, 0].tolist() == [*range(20)]


@pytest.mark.long
@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('time = "sim"\n', "", 'timelines sim, number: add time = "sim"'),
        ('"sim"', '"simulated"', "timeline 'simulated' does not exist. Available: log_time, number, sim"),
        ('"/imu"', '"/imi"', "topic in column '/imi'"),
        ('"/imu"', '"/stage"', "has text"),
    ],
)
def test_wrong_maps_name_the_value(log: Path, tmp_path: Path, old: str, new: str, message: str) -> None:
    mapping = read_map(map_file(tmp_path, MAP.replace(old, new, 1)))
    with pytest.raises(BadInput, match=message):
        read_log(read_columns(log, mapping), mapping, "log")


@pytest.mark.first(1)
@pytest.mark.parametrize("size", [0, 15, 4000])
def test_damaged_files_are_refused(log: Path, tmp_path: Path, size: int) -> None:
    (tmp_path / "log.rrd").write_bytes(log.read_bytes()[:size])
    with pytest.raises(BadInput, match=r"log\.rrd") as error:
        read_columns(tmp_path / "log.rrd")
    assert "\n" not in str(error.value)
