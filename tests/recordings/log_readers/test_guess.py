"""First maps: names that are not English, several estimates, and a format without a reader."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.log_readers.columns import preview_columns
from beliefscope.recordings.log_readers.guess import guess_map
from beliefscope.recordings.log_readers.messages import Preview


def test_a_guessed_map_keeps_letters_dates_and_texts() -> None:
    t = np.arange(20.0)
    columns = {
        "Zeit": np.datetime64("2026-01-01T00:00") + t.astype("timedelta64[s]"),
        "timestamp": t,
        "Fahrt": np.array(["A"] * 20),
        "Kurs ψ": t,
        "Kompass °": t,
        "ekf.mean": np.stack([t, t], 1),
        "ekf.std": np.stack([t, t], 1),
    }
    text = guess_map(Preview(columns), "log")
    values = tomllib.loads(text)
    assert values["time"] == "timestamp"
    assert values["estimate"] == {"mean": "ekf.mean", "std": "ekf.std"}
    assert values["sensors"] == {"Kurs_ψ": "Kurs ψ", "Kompass": "Kompass °"}
    assert '# not numbers, for time, episode or [covariates]: ["Zeit", "Fahrt"]' in text
    del columns["timestamp"]
    assert tomllib.loads(guess_map(Preview(columns), "log"))["time"] == "Zeit"


def test_the_estimate_of_a_filter_precedes_the_odometry_of_the_wheels() -> None:
    fields = ("position.x", "position.y", "position.z", *(f"orientation.{axis}" for axis in "xyzw"))
    poses = ("/wheel/odometry.pose.pose", "/mocap.pose", "/odometry/filtered.pose.pose")
    columns = {f"{pose}.{field}": np.ones(3) for pose in poses for field in fields}
    intervals = {"/wheel/odometry": 0.05, "/mocap": 0.01, "/odometry/filtered": 0.03}
    values = tomllib.loads(guess_map(Preview(columns, intervals), "drive"))
    assert values["state"]["x"] == "/mocap.pose.position.x"
    assert values["estimate"]["mean"][0] == "/odometry/filtered.pose.pose.position.x"
    assert values["dt"] == 0.03


def test_a_table_of_a_filter_has_its_estimate_covariance_and_controls() -> None:
    elements = [f"P{i}{j}" for i in range(2) for j in range(2)]
    names = ["t", "true_x", "true_yaw", "gps_x", "cmd_v", "cmd_w", "ekf_x", "ekf_yaw", *elements]
    values = tomllib.loads(guess_map(Preview({name: np.ones(3) for name in names}), "drive"))
    assert values["control"] == ["cmd_v", "cmd_w"]
    assert values["sensors"] == {"gps_x": "gps_x"}
    assert values["estimate"] == {"mean": ["ekf_x", "ekf_yaw"], "covariance": elements}


def test_a_bag_of_ros_1_is_refused_with_the_command_that_converts_it(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"drive.bag is a bag of ROS 1; convert it: .*--src drive.bag --dst drive"):
        preview_columns(tmp_path / "drive.bag")


def test_units_of_sensors_are_those_of_their_columns_and_values_of_the_filter_are_no_sensors() -> None:
    names = ["t", "true_x", "cam_x_mm", "tilt_deg", "speed", "pf.x_mm", "pf.P00", "pf.innov.x", "pf.n_eff"]
    text = guess_map(Preview({name: np.ones(3) for name in names}), "drive")
    values = tomllib.loads(text)
    sensors = {"cam_x_mm": {"column": "cam_x_mm", "unit": "mm"}, "tilt_deg": {"column": "tilt_deg", "unit": "deg"}}
    assert values["sensors"] == sensors | {"speed": "speed"}
    assert values["estimate"] == {"mean": "pf.x_mm", "covariance": "pf.P00"}
    assert '# of the filter, neither sensors nor estimates: ["pf.innov.x", "pf.n_eff"]' in text
    columns = {"/compass.heading_deg": np.ones(3), "/lidar.range": np.ones(3), "/lidar.bearing_deg": np.ones(3)}
    columns |= {"/cmd_vel.linear.x": np.ones(3), "/cmd_vel.angular.z": np.ones(3)}
    topics = dict.fromkeys(("/compass", "/lidar", "/cmd_vel"), 0.1)
    values = tomllib.loads(guess_map(Preview(columns, topics), "drive"))
    assert values["control"] == ["/cmd_vel.linear", "/cmd_vel.angular"]
    assert values["sensors"]["compass"] == {"column": "/compass", "unit": "deg"}
    assert values["sensors"]["lidar"] == {"column": "/lidar", "unit": ["", "deg"]}
