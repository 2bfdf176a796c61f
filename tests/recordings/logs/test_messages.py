"""Logs of messages: MCAP and ROS 2 bags give the same columns on the clock of the map."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

import log_files as logs

from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.logs.column_map import read_map
from beliefscope.recordings.logs.columns import preview_columns, read_columns
from beliefscope.recordings.logs.guess import guess_map
from beliefscope.recordings.logs.images import LUMA
from beliefscope.recordings.logs.read_log import read_log, recorded_trace

DT = 0.05

MAP = """
dt = 0.05
[state]
x = "/truth.pose.pose.position.x"
y = {column = "/truth.pose.pose.position.y", unit = "m"}
yaw = {column = "/truth.pose.pose.orientation", unit = "quaternion_yaw"}
[sensors]
gyro = "/imu.angular_velocity"
image = "/camera.data"
[covariates]
stage = "/stage.data"
age = {column = "/odom.age", cuts = [0.02], unit = "s"}
[estimate]
mean = ["/odom.pose.pose.position.x", "/odom.pose.pose.position.y", "/odom.pose.pose.orientation"]
covariance = "/odom.pose.covariance[0,1,5,6,7,11,30,31,35]"
"""


@pytest.fixture(params=logs.MESSAGE_LOGS)
def log(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    name, write = logs.MESSAGE_LOGS[request.param]
    write(tmp_path / name)
    return tmp_path / name


@pytest.fixture
def json_log(tmp_path: Path) -> Path:
    logs.write_json_mcap(tmp_path / "log.mcap")
    return tmp_path / "log.mcap"


def map_file(folder: Path, text: str = MAP) -> Path:
    path = folder / "map.toml"
    path.write_text(text)
    return path


def test_columns_have_the_last_message_at_each_tick(log: Path, tmp_path: Path) -> None:
    """The clock starts when state and sensors have messages, here 0.1 s, and ends with the truth, at 2 s."""
    mapping = read_map(map_file(tmp_path, MAP.partition("[estimate]")[0]))
    columns = read_columns(log, mapping)
    ticks = np.arange(0.1, 2.0 + 1e-9, DT)
    (episode,) = read_log(columns, mapping, log.name)
    truth = np.stack([logs.pose(t) for t in logs.held("/truth", ticks)])
    np.testing.assert_allclose(episode.states, truth, atol=1e-6)
    gyro = np.stack([logs.spin(t) for t in logs.held("/imu", ticks)])
    np.testing.assert_allclose(episode.observations["gyro"], gyro, atol=1e-6)
    images = np.stack([np.rint(logs.colour(t) @ LUMA) for t in logs.held("/camera", ticks)])
    assert np.array_equal(episode.observations["image"], images.astype(np.uint8))
    stages = [np.nan if np.isnan(t) else ["lift", "reach"].index(logs.stage(t)) for t in logs.held("/stage", ticks)]
    assert np.array_equal(episode.covariate("stage"), np.array(stages, np.float32), equal_nan=True)
    assert np.isnan(stages[:10]).all()
    age = ticks - logs.held("/odom", ticks)
    np.testing.assert_allclose(episode.covariate("age"), age, atol=1e-6)
    assert np.isnan(age[:5]).all()
    assert not np.isnan(age[5:]).any()


def test_a_recorded_estimate_becomes_a_trace(log: Path, tmp_path: Path) -> None:
    """The clock starts with the first message of the estimate."""
    mapping = read_map(map_file(tmp_path))
    columns = read_columns(log, mapping)
    trace = recorded_trace(columns, mapping, read_log(columns, mapping, log.name), 0, log.name)
    times = logs.held("/odom", np.arange(0.35, 2.0 + 1e-9, DT))
    np.testing.assert_allclose(trace.estimate_mean, [logs.pose(t) for t in times], atol=1e-5)
    variance = np.array([0.04, 0.09, 0.01]) * (1.0 + times[:, None])
    np.testing.assert_allclose(trace.estimate_covariance, variance[:, :, None] * np.eye(3), rtol=1e-5)


def test_compressed_images_have_their_colours(log: Path, tmp_path: Path) -> None:
    text = 'dt = 0.5\n[state]\nx = ""\ny = ""\n[sensors]\nfront = "/preview.data"\n'
    columns = read_columns(log, read_map(map_file(tmp_path, text)))
    assert np.array_equal(columns["/preview.data"], [logs.colour(t) for t in (0.01, 0.51, 1.01, 1.51)])


def test_a_guessed_map_imports_the_log(log: Path, tmp_path: Path) -> None:
    """The pose named truth becomes the state, the other one the estimate, the rest sensors; text is left out."""
    text = guess_map(preview_columns(log), log.stem)
    values = tomllib.loads(text)
    assert values["dt"] == pytest.approx(0.02)
    assert values["state"]["yaw"] == {"column": "/truth.pose.pose.orientation", "unit": "quaternion_yaw"}
    assert values["sensors"]["imu_angular_velocity"] == "/imu.angular_velocity"
    assert values["sensors"]["camera_data"] == "/camera.data"
    assert values["estimate"]["covariance"].startswith("/odom.pose.covariance[")
    assert "stage" not in text
    mapping = read_map(map_file(tmp_path, text))
    columns = read_columns(log, mapping)
    (episode,) = read_log(columns, mapping, log.name)
    np.testing.assert_allclose(episode.states[-1], logs.pose(2.0), atol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("/truth.pose.pose.position.x", "/true.pose.pose.position.x", "topic of column '/true.pose.*'/camera|/camera,"),
        (
            "/truth.pose.pose.position.x",
            "/truth.pose.pose.position.u",
            "field of column .* 'u' does not exist.* x, y, z",
        ),
        ("/imu.angular_velocity", "/stage.data", "column '/stage.data' of sensor gyro has text"),
        ("covariance[0,1,5,6,7,11,30,31,35]", "covariance[0,1,99]", r"no \[0,1,99\]"),
        ("covariance[0,1,5,6,7,11,30,31,35]", "covariance", "36 numbers per row, expected 9"),
        ("dt = 0.05", 'time = "t"', "the map needs dt"),
        ("dt = 0.05", "dt = 1e-9", "increase dt"),
        ("dt = 0.05", "dt = inf", "needs either dt"),
        ('"quaternion_yaw"', '"rad"', r"shape \(34, 4\), expected \(34, 1\)"),
        ('"/truth.pose.pose.orientation"', '["/truth.pose.pose.position.x"]', "four of a quaternion_yaw"),
        ('"/truth.pose.pose.orientation"', '"/truth.header.frame_id"', "has text"),
    ],
)
def test_wrong_maps_name_the_value(json_log: Path, tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in MAP
    path = map_file(tmp_path, MAP.replace(old, new))

    def read() -> None:
        mapping = read_map(path)
        columns = read_columns(json_log, mapping)
        recorded_trace(columns, mapping, read_log(columns, mapping, "log"), 0, "log")

    with pytest.raises(BadInput, match=message) as error:
        read()
    assert "\n" not in str(error.value)
