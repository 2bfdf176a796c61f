"""Estimates in the forms that robots log them: quaternions in four columns, covariances of six components."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from beliefscope.datasets.errors import BadInput
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.log_readers.column_map import read_map
from beliefscope.recordings.log_readers.columns import read_columns
from beliefscope.recordings.log_readers.read_log import read_log, recorded_trace

STEPS = 10
PLANAR = "P[0,1,5,6,7,11,30,31,35]"
MAP = """
dt = 0.1
[state]
x = "x"
y = "y"
yaw = {column = ["qx", "qy", "qz", "qw"], unit = "quaternion_yaw"}
[estimate]
mean = ["est_x", "est_y", ["est_qx", "est_qy", "est_qz", "est_qw"]]
covariance = "P[0,1,5,6,7,11,30,31,35]"
"""


def imported(folder: Path, covariance: np.ndarray, text: str = MAP) -> Trace:
    yaw = np.linspace(-3.0, 3.0, STEPS)
    pose = {"x": np.arange(STEPS), "y": np.ones(STEPS), "qx": 0.0 * yaw, "qy": 0.0 * yaw}
    pose |= {"qz": np.sin(yaw / 2.0), "qw": np.cos(yaw / 2.0)}
    np.savez(folder / "log.npz", P=covariance, **pose, **{f"est_{name}": values for name, values in pose.items()})
    (folder / "map.toml").write_text(text)
    mapping = read_map(folder / "map.toml")
    columns = read_columns(folder / "log.npz", mapping)
    return recorded_trace(columns, mapping, read_log(columns, mapping, "log.npz"), 0, "log.npz")


@pytest.mark.parametrize("shape", [(36,), (6, 6)])
def test_planar_estimate_of_a_pose_in_space(tmp_path: Path, shape: tuple[int, ...]) -> None:
    matrix = np.arange(36.0).reshape(6, 6) + np.arange(36.0).reshape(6, 6).T
    run = imported(tmp_path, np.broadcast_to(matrix.reshape(shape), (STEPS, *shape)))
    np.testing.assert_allclose(run.estimate_covariance[3], matrix[np.ix_([0, 1, 5], [0, 1, 5])])
    np.testing.assert_allclose(run.estimate_mean[:, 2], np.linspace(-3.0, 3.0, STEPS), atol=1e-6)
    np.testing.assert_allclose(run.estimate_mean, run.episode.states, atol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (PLANAR, "P", r"36 numbers per row, expected 9; \[0,1,5,6,7,11,30,31,35\] are those of x, y and yaw"),
        ('["est_qx", "est_qy", "est_qz", "est_qw"]', '"est_qx", "est_qw"', "a quaternion is one entry, a column or a"),
        ('["est_qx", "est_qy", "est_qz", "est_qw"]', '["est_qx", "est_qw"]', "expected the name of a column or a list"),
    ],
)
def test_wrong_entries_have_a_hint(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(BadInput, match=message):
        imported(tmp_path, np.ones((STEPS, 6, 6)), MAP.replace(old, new))


def test_a_covariance_of_zeros_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"covariance of .estimate. is zero in all rows; remove it from the map"):
        imported(tmp_path, np.zeros((STEPS, 36)))
