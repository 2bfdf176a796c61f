"""Names in the map of a log's columns."""

from __future__ import annotations

from pathlib import Path

import pytest

from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.log_readers.column_map import ColumnMap, read_map


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
