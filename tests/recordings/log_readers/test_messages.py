"""Logs of messages: MCAP and ROS 2 bags give the same columns on the clock of the map."""

from __future__ import annotations

import json
import re
import sys
import tomllib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

import log_files as logs

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.export import export_trace
from beliefscope.recordings.log_readers.column_map import read_map
from beliefscope.recordings.log_readers.columns import preview_columns, read_columns
from beliefscope.recordings.log_readers.guess import guess_map
from beliefscope.recordings.log_readers.messages import late_estimates, on_clock
from beliefscope.recordings.log_readers.read_log import read_log, recorded_trace

ROOT = Path(__file__).parents[3]
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
    images = np.stack([logs.colour(t) for t in logs.held("/camera", ticks)])
    assert np.array_equal(episode.observations["image"], images)
    assert episode.observations["image"].dtype == np.uint8
    stages = [np.nan if np.isnan(t) else ["lift", "reach"].index(logs.stage(t)) for t in logs.held("/stage", ticks)]
    assert np.array_equal(episode.covariate("stage"), np.array(stages, np.float32), equal_nan=True)
    assert np.isnan(stages[:10]).all()
    age = ticks - logs.held("/odom", ticks)
    np.testing.assert_allclose(episode.covariate("age"), age, atol=1e-6)
    assert np.isnan(age[:5]).all()
    assert not np.isnan(age[5:]).any()


def test_steps_are_the_messages_of_a_clock(json_log: Path, tmp_path: Path) -> None:
    """Those of the camera from 0.25 s on, when state and sensors have messages; the state's topic is faster."""
    text = MAP.partition("[estimate]")[0].replace("dt = 0.05", 'clock = "/camera"')
    mapping = read_map(map_file(tmp_path, text))
    (episode,) = read_log(read_columns(json_log, mapping), mapping, json_log.name)
    ticks = np.arange(0.25, 1.85 + 1e-9, 0.2)
    assert (episode.dt, episode.time) == (pytest.approx(0.2), None)
    np.testing.assert_allclose(episode.states, [logs.pose(t) for t in logs.held("/truth", ticks)], atol=1e-6)
    np.testing.assert_allclose(episode.covariate("age"), ticks - logs.held("/odom", ticks), atol=1e-6)
    with pytest.raises(BadInput, match=r"map.toml has dt and clock"):
        read_map(map_file(tmp_path, f"dt = 1.0\n{text}"))
    mapping = read_map(map_file(tmp_path, text.replace('"/camera"', '"/camra"')))
    with pytest.raises(BadInput, match="camra"):
        read_columns(json_log, mapping)


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
    assert values["dt"] == pytest.approx(0.03)
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
            "field 'u' of column .* does not exist.* x, y, z",
        ),
        ("/imu.angular_velocity", "/stage.data", "column '/stage.data' of sensor gyro has text"),
        ("covariance[0,1,5,6,7,11,30,31,35]", "covariance[0,1,99]", r"no \[0,1,99\]"),
        ("covariance[0,1,5,6,7,11,30,31,35]", "covariance", "36 numbers per row, expected 9"),
        ("dt = 0.05", 'time = "t"', "the map needs dt"),
        ("dt = 0.05", "dt = 1e-9", "increase dt"),
        ("dt = 0.05", "dt = inf", "needs either dt"),
        ('"quaternion_yaw"', '"rad"', r"shape \(34, 4\), expected \(34, 1\)"),
        ('"/truth.pose.pose.orientation"', '["/truth.pose.pose.position.x"]', "four of a quaternion"),
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


def test_a_bag_written_by_ros(tmp_path: Path) -> None:
    """Values are the defaults in the definition of test_msgs/Arrays."""
    bag = Path(__file__).with_name("rosbag2_cdr_test")
    text = 'dt = 0.05\n[state]\nx = "/test_topic.int32_value"\ny = ""\n'
    text += '[sensors]\nfloats = "/array_topic.float32_values_default"\n'
    text += 'limits = "/array_topic.int16_values_default"\n'
    mapping = read_map(map_file(tmp_path, text))
    columns = read_columns(bag, mapping)
    (episode,) = read_log(columns, mapping, "bag")
    assert set(episode.states[:, 0]) == {123.0}
    assert np.array_equal(episode.observations["floats"], len(episode) * [[1.125, 0.0, -1.125]])
    assert np.array_equal(episode.observations["limits"], len(episode) * [[0, 32767, -32768]])
    assert not [name for name in preview_columns(bag).columns if "__" in name]


def test_topics_that_differ_from_the_metadata_have_messages(tmp_path: Path) -> None:
    """In bags of some versions of ROS, metadata.yaml has another quality of service than the file."""
    from rosbags.rosbag2 import Reader

    logs.write_bag(tmp_path / "bag")
    metadata = tmp_path / "bag" / "metadata.yaml"
    times = ("deadline", "lifespan", "liveliness_lease_duration")
    quality = {"history": 1, "depth": 9, "reliability": 1, "durability": 2, "liveliness": 1}
    quality |= {"avoid_ros_namespace_conventions": False} | {name: {"sec": 0, "nsec": 0} for name in times}
    metadata.write_text(metadata.read_text().replace("profiles: []", f"profiles: {json.dumps([quality])}"))
    with Reader(tmp_path / "bag") as reader:
        assert reader.connections
        assert not [*reader.messages()]
    text = MAP.partition("[covariates]")[0]
    assert len(read_columns(tmp_path / "bag", read_map(map_file(tmp_path, text)))["/imu.angular_velocity"]) == 39


def test_a_topic_names_the_episodes(json_log: Path, tmp_path: Path) -> None:
    """The stage changes at 1.1 s; the clock starts with its first message at 0.6 s."""
    text = MAP.partition("[covariates]")[0].replace("dt = 0.05", 'dt = 0.05\nepisode = "/stage.data"')
    mapping = read_map(map_file(tmp_path, text))
    episodes = read_log(read_columns(json_log, mapping), mapping, "log")
    assert {e.provenance["episode"]: len(e) for e in episodes} == {"reach": 10, "lift": 19}


def test_lists_of_messages_are_particles(tmp_path: Path) -> None:
    """A pose array with five members: each column of x and y has one value per member."""
    from mcap.writer import Writer

    with (tmp_path / "log.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/cloud", "json", 0)
        for step in range(10):
            poses = [{"position": {"x": step + i, "y": step * i}} for i in range(5)]
            writer.add_message(channel, step * 10**8, json.dumps({"poses": poses}).encode(), 0)
        writer.finish()
    text = 'dt = 0.1\n[state]\nx = ""\ny = ""\n'
    text += '[estimate]\nparticles = ["/cloud.poses.position.x", "/cloud.poses.position.y"]\n'
    mapping = read_map(map_file(tmp_path, text))
    columns = read_columns(tmp_path / "log.mcap", mapping)
    trace = recorded_trace(columns, mapping, read_log(columns, mapping, "log"), 0, "log")
    assert trace.particles is not None
    assert trace.particles[3].tolist() == [[3.0 + i, 3.0 * i] for i in range(5)]
    np.testing.assert_allclose(trace.estimate_mean[3], [5.0, 6.0])


def test_a_topic_that_cannot_be_decoded_only_matters_if_it_is_used(tmp_path: Path) -> None:
    from mcap.writer import Writer

    with (tmp_path / "log.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, encoding, data in (("/good", "json", b'{"x": 1.5}'), ("/bad", "protobuf", b"?")):
            channel = writer.register_channel(topic, encoding, 0)
            for step in range(4):
                writer.add_message(channel, step * 10**8, data, 0)
        writer.finish()
    assert [*preview_columns(tmp_path / "log.mcap").columns] == ["/good.x"]
    text = 'dt = 0.1\n[state]\nx = "/good.x"\ny = "/bad.x"\n'
    with pytest.raises(BadInput, match="topic '/bad' is encoded as protobuf, expected json, or cdr"):
        read_columns(tmp_path / "log.mcap", read_map(map_file(tmp_path, text)))


def test_the_documented_map_is_valid(json_log: Path, tmp_path: Path) -> None:
    blocks = re.findall(r"```toml\n(.*?)```", (ROOT / "docs" / "import.md").read_text(), re.DOTALL)
    (text,) = (block for block in blocks if "/truth" in block)
    assert len(text.splitlines()) <= 10
    mapping = read_map(map_file(tmp_path, text))
    assert len(read_log(read_columns(json_log, mapping), mapping, "log")[0]) == 34


def test_an_exported_trace_is_imported_again(new_trace: Callable[[str], Trace], tmp_path: Path) -> None:
    """State and estimate are found by their names; the default clock has the steps of the trace."""
    recorded = new_trace("pf")
    export_trace(recorded, tmp_path / "run.mcap")
    mapping = read_map(map_file(tmp_path, guess_map(preview_columns(tmp_path / "run.mcap"), "run")))
    columns = read_columns(tmp_path / "run.mcap", mapping)
    episodes = read_log(columns, mapping, "run")
    np.testing.assert_allclose(episodes[0].states, recorded.episode.states, rtol=1e-6)
    again = recorded_trace(columns, mapping, episodes, 0, "run")
    np.testing.assert_allclose(again.estimate_mean, recorded.estimate_mean, rtol=1e-6)


def test_files_without_an_index_are_refused(json_log: Path, tmp_path: Path) -> None:
    """A recorder that was killed writes no summary."""
    (tmp_path / "cut.mcap").write_bytes(json_log.read_bytes()[:-3000])
    with pytest.raises(BadInput, match=r"cut\.mcap: not a complete MCAP file .* `mcap recover` repairs") as error:
        preview_columns(tmp_path / "cut.mcap")
    assert "\n" not in str(error.value)


def test_the_command_line_imports_a_log(json_log: Path, tmp_path: Path, run: Callable[..., tuple]) -> None:
    """A data set with the map's sensors, and one line with the cause for a wrong map."""
    code, _, error = run("import", json_log, "--map", map_file(tmp_path), "-o", tmp_path / "log.h5")
    assert (code, error) == (0, "")
    with open_dataset(tmp_path / "log.h5") as data:
        assert [*data.task.observations] == ["gyro", "image"]
    code, _, error = run(
        "import", json_log, "--map", map_file(tmp_path, MAP.replace("/imu", "/imi")), "-o", tmp_path / "b.h5"
    )
    assert code == 2
    assert error.startswith("error: log.mcap: topic in column '/imi.angular_velocity' does not exist")
    assert error.count("\n") == 1
    unknown = map_file(tmp_path, MAP.replace('"/truth.pose.pose.position.x"', '""'))
    code, _, error = run("import", json_log, "--map", unknown, "-o", tmp_path / "b.h5")
    assert (code, (tmp_path / "b.h5").exists()) == (2, False)
    assert "x is unknown in episode 0: a data set needs all states" in error


class DelayedEstimates:
    """Truth every 50 ms, with estimates some ms later."""

    topics = ("/truth", "/estimate")
    second = 1000.0
    timeline = ""

    def __init__(self, delay: int) -> None:
        self.delay = delay

    def messages(self, topics: Sequence[str]) -> Iterator[tuple[str, int, Callable[[], Any]]]:
        for k in range(40):
            for topic, time in (("/truth", 50 * k), ("/estimate", 50 * k + self.delay)):
                if topic in topics:
                    yield topic, time, lambda: {"x": 0.0}


@pytest.mark.parametrize(
    ("delay", "clock", "expected"),
    [
        (4, "dt = 0.05", "100 % of the estimates are published just after the tick of their state (typically 4 ms)"),
        (4, 'clock = "/truth"', "the clock of the map, in place of /truth"),
        (4, 'clock = "/estimate"', ""),
        (0, "dt = 0.05", ""),
        (30, "dt = 0.05", ""),
    ],
)
def test_estimates_just_after_the_ticks_cause_a_warning(tmp_path: Path, delay: int, clock: str, expected: str) -> None:
    text = f'{clock}\n[state]\nx = "/truth.x"\n[estimate]\nmean = "/estimate.x"\n'
    mapping = read_map(map_file(tmp_path, text))
    warning = late_estimates(on_clock(DelayedEstimates(delay), mapping), mapping)
    assert expected in warning if expected else warning == ""
