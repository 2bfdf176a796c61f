"""Names in the map of a log's columns."""

from __future__ import annotations

from beliefscope.recordings.log_readers.column_map import ColumnMap


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
