"""Names in the map of a log's columns."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.log_readers.column_map import ColumnMap, read_map
from beliefscope.recordings.log_readers.read_log import read_log


def test_channels_are_named_after_their_columns() -> None:
    sensors: dict[str, str | list[str]] = {
        "gps": ["gps_lat", "gps_lon"],
        "imu": ["/imu/data.gyro.z", "/imu/data.acc.x"],
        "twice": ["gps_lat", "gps_lat"],
        "pair": ["left", "left_right"],
        "array": "ranges",
    }
    mapping = ColumnMap("rover", {}, control=["throttle", "steering"], sensors=sensors)
    sizes = {"gps": 2, "imu": 2, "twice": 2, "pair": 2, "array": 8, "control": 2}
    names = {key: [channel.name for channel in each] for key, each in mapping.channels(sizes).items()}
    assert names == {
        "gps": ["lat", "lon"],
        "imu": ["gyro.z", "acc.x"],
        "pair": ["left", "left_right"],
        "control": ["throttle", "steering"],
    }


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ('größe = "x"', '; names with other letters than A to Z are quoted: "größe"'),
        ('[state]\nψ = "x"', 'are quoted: "ψ"'),
        ('[zustände]\nx = "x"', 'are quoted: "zustände"'),
        ('a b = "ψ" # ψ', ""),
    ],
)
def test_the_error_of_a_bare_key_with_other_letters_has_a_hint(tmp_path: Path, text: str, hint: str) -> None:
    path = tmp_path / "map.toml"
    path.write_text(text)
    with pytest.raises(BadInput, match=r"map.toml cannot be read: .* \(at line \d+, column \d+\)") as error:
        read_map(path)
    assert str(error.value).endswith(hint or ")")


UNITS = """dt = 0.1
[state]
x = "x"
[sensors]
compass = {column = "heading", unit = "deg"}
marker = {column = ["u", "v", "turn"], valid = "seen", unit = ["mm", "mm", "deg"]}
imu = {column = "rates", unit = "rad/s"}
"""


def test_readings_are_converted_from_their_units(tmp_path: Path) -> None:
    (tmp_path / "map.toml").write_text(UNITS)
    heading, place = np.array([10.0, 350.0, 90.0]), np.array([1.0, 2.0, 3.0])
    columns = {"x": place, "heading": heading, "u": place, "v": place, "turn": heading, "seen": np.array([1, 0, 1])}
    columns["rates"] = np.ones((3, 4))
    (episode,) = read_log(columns, read_map(tmp_path / "map.toml"), "log")
    np.testing.assert_allclose(episode.observations["compass"][:, 0], np.radians(heading), rtol=1e-6)
    np.testing.assert_allclose(episode.observations["marker"][2], [0.003, 0.003, np.pi / 2], rtol=1e-6)
    assert "marker" in episode.task.masks
    channels = [("compass", "rad"), ("marker u", "m"), ("marker v", "m"), ("marker turn", "rad")]
    channels += [(f"imu {i}", "rad/s") for i in range(4)]
    assert [(channel.name, channel.unit) for channel in episode.task.vector_channels()] == channels


@pytest.mark.parametrize(
    ("unit", "error"),
    [
        ('"degrees"', "unit of sensor 'compass' is 'degrees', expected 'deg'"),
        ('"quaternion"', "unit of sensor 'compass' is 'quaternion', which is one of the state only"),
        ("1", "unit of sensor 'compass' is 1, expected a text such as deg or m/s, or one for each"),
        ('["deg", "mm"]', "sensor 'compass' has 1 channel and 2 units"),
    ],
)
def test_units_that_a_sensor_cannot_have_are_refused(tmp_path: Path, unit: str, error: str) -> None:
    (tmp_path / "map.toml").write_text(UNITS.split("marker")[0].replace('"deg"', unit))
    columns = {"x": np.arange(3.0), "heading": np.arange(3.0)}
    with pytest.raises(BadInput, match=re.escape(error)):
        read_log(columns, read_map(tmp_path / "map.toml"), "log")
