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


@pytest.mark.parametrize("elements", [["P00", "P01", "P10", "P11"], ["Pxx", "Pxy", "Pyx", "Pyy"]])
def test_a_table_of_a_filter_has_its_estimate_covariance_and_controls(elements: list[str]) -> None:
    names = ["t", "true_x", "true_yaw", "gps_x", "cmd_v", "cmd_w", "ekf_x", "ekf_yaw", *elements]
    values = tomllib.loads(guess_map(Preview({name: np.ones(3) for name in names}), "drive"))
    assert values["control"] == ["cmd_v", "cmd_w"]
    assert values["sensors"] == {"gps_x": "gps_x"}
    assert values["estimate"] == {"mean": ["ekf_x", "ekf_yaw"], "covariance": elements}


@pytest.mark.parametrize(
    ("elements", "square"),
    [
        (["Pxx", "Pxy", "Pyy"], ["Pxx", "Pxy", "Pxy", "Pyy"]),
        (["P_0_0", "P_1_0", "P_1_1"], ["P_0_0", "P_1_0", "P_1_0", "P_1_1"]),
        (["cov[0,0]", "cov[0,1]", "cov[1,1]"], ["cov[0,0]", "cov[0,1]", "cov[0,1]", "cov[1,1]"]),
        (["Pxx", "Pxy", "Pxz"], None),
        (["Pxx", "Pyy"], None),
    ],
)
def test_a_triangle_of_a_covariance_is_completed(elements: list[str], square: list[str] | None) -> None:
    names = ["t", "true_x", "true_y", "ekf_x", "ekf_y", *elements]
    values = tomllib.loads(guess_map(Preview({name: np.ones(3) for name in names}), "drive"))
    assert values["estimate"].get("covariance") == square


def test_a_bag_of_ros_1_is_refused_with_the_command_that_converts_it(tmp_path: Path) -> None:
    (tmp_path / "drive.bag").touch()
    with pytest.raises(BadInput, match=r"drive.bag is a bag of ROS 1; convert it: .*--src drive.bag --dst drive"):
        preview_columns(tmp_path / "drive.bag")


@pytest.mark.parametrize("name", ["bag", "buffer.zarr", "drive.bag", "log.csv"])
def test_a_missing_log_is_not_said_to_have_a_wrong_format(name: str, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=rf"{name} does not exist"):
        preview_columns(tmp_path / name)


def test_units_of_sensors_are_those_of_their_columns_and_values_of_the_filter_are_no_sensors() -> None:
    names = ["t", "true_x", "cam_x_mm", "tilt_deg", "speed", "pf.x_mm", "pf.P00", "pf.innov.x", "pf.n_eff"]
    text = guess_map(Preview({name: np.ones(3) for name in names}), "drive")
    values = tomllib.loads(text)
    sensors = {"cam_x": {"column": "cam_x_mm", "unit": "mm"}, "tilt": {"column": "tilt_deg", "unit": "deg"}}
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


def test_standard_deviations_belong_to_the_components_of_the_estimate() -> None:
    names = ["t", "true_x", "true_y", "est_y", "est_x"]
    for deviations in (["sx", "sy"], ["sd_x", "sd_y"], ["x_sigma", "y_sigma"], ["est_s_x", "est_s_y"]):
        values = tomllib.loads(guess_map(Preview({n: np.ones(3) for n in [*names, *deviations[::-1]]}), "drive"))
        assert values["estimate"] == {"mean": ["est_x", "est_y"], "std": deviations}
        assert values["sensors"] == {}
    text = guess_map(Preview({n: np.ones(3) for n in [*names, "sx"]}), "drive")
    assert '# std needs 2 columns, one for each of mean; the log has ["sx"]' in text
    assert tomllib.loads(text)["estimate"] == {"mean": ["est_x", "est_y"]}
    sensors = tomllib.loads(guess_map(Preview({n: np.ones(3) for n in ["t", "true_x", "sx"]}), "drive"))["sensors"]
    assert sensors == {"sx": "sx"}  # without an estimate


def test_angles_beyond_a_turn_are_proposed_in_degrees() -> None:
    t = np.arange(5.0)
    columns = {
        "t": t,
        "true_yaw": t,
        "true_roll": np.where(t > 3.0, np.nan, 90.0 * t),
        "compass_heading": 90.0 - 90.0 * t,
    }
    text = guess_map(Preview(columns), "drive")
    values = tomllib.loads(text)
    assert [values["state"][name]["unit"] for name in ("yaw", "roll")] == ["rad", "deg"]
    assert values["sensors"]["compass_heading"]["unit"] == "deg"
    assert 'unit = "deg"}  # 0 to 270: check the unit\n' in text
    assert 'unit = "deg"}  # -270 to 90: check the unit\n' in text


@pytest.mark.parametrize(
    ("name", "start", "unit"),
    [("time_ms", 0.0, "ms"), ("Time [us]", 0.0, "us"), ("stamp", 1.7e18, "ns"), ("timestamp", 1.7e12, "ms")],
)
def test_units_of_times_follow_from_their_name_or_size(name: str, start: float, unit: str) -> None:
    columns = {name: start + np.arange(3.0), "true_x": np.ones(3)}
    assert tomllib.loads(guess_map(Preview(columns), "drive"))["time"] == {"column": name, "unit": unit}


def test_names_beside_those_of_an_estimate_are_true_states() -> None:
    names = ["Time [s]", "x [m]", "heading [deg]", "x_hat", "heading_hat", "v_hat", "P_xx", "wheel (m/s)"]
    text = guess_map(Preview({name: np.ones(3) for name in names}), "drive")
    values = tomllib.loads(text)
    assert values["time"] == "Time [s]"
    v = {"column": "", "unit": "m/s"}
    assert values["state"] == {"x": "x [m]", "heading": {"column": "heading [deg]", "unit": "deg"}, "v": v}
    assert values["estimate"] == {"mean": ["x_hat", "heading_hat", "v_hat"]}
    assert values["sensors"] == {"wheel": {"column": "wheel (m/s)", "unit": "m/s"}}
    assert '# of the filter, neither sensors nor estimates: ["P_xx"]' in text


def test_readings_close_to_the_truth_have_its_unit() -> None:
    x = 100.0 * np.sin(np.arange(40.0))
    columns = {"t": np.arange(40.0), "true_x_cm": x, "true_y": 0.01 * x, "est_x": x}
    columns |= {"gps_x": x + 10.0, "gps_y": 0.01 * x, "force_x": 0.1 * x, "force_y": x}
    sensors = tomllib.loads(guess_map(Preview(columns), "drive"))["sensors"]
    assert sensors["gps"] == {"column": ["gps_x", "gps_y"], "unit": ["cm", "m"]}
    assert sensors["force"] == ["force_x", "force_y"]
