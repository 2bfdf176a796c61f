"""Innovations of the measurements in logs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beliefscope.datasets.errors import BadInput
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.log_readers.column_map import read_map
from beliefscope.recordings.log_readers.messages import NEW
from beliefscope.recordings.log_readers.read_log import read_log, recorded_trace

MAP = """dt = 0.1
[state]
x = "x"
[sensors]
gps = ["east", "north"]
compass = {column = "heading", unit = "deg"}
[estimate]
mean = ["x"]
[innovations]
compass = {innovation = "nu_c", std = "sd_c", unit = "deg"}
gps = {innovation = ["nu_e", "nu_n"], covariance = "S", accepted = "used"}
"""


def imported(folder: Path, text: str = MAP, **others: Any) -> Trace:
    (folder / "map.toml").write_text(text)
    t = np.arange(4.0)
    columns = dict.fromkeys(("x", "east", "north", "heading", "nu_e", "nu_n"), t)
    columns["nu_c"] = np.array([1.0, np.nan, -2.0, 3.0])
    columns |= {"sd_c": np.full(4, 3.0), "S": np.tile([4.0, 1.0, 1.0, 9.0], (4, 1)), "used": np.array([1, 0, 1, 1])}
    mapping = read_map(folder / "map.toml")
    columns |= others
    return recorded_trace(columns, mapping, read_log(columns, mapping, "log"), 0, "log")


def test_innovations_of_a_log_are_in_the_trace(tmp_path: Path) -> None:
    """In the unit of the map, NaN without a measurement and after the last channel; a step without a new message."""
    new = {f"{NEW}nu_e": np.array([True, True, False, True])}
    trace = imported(tmp_path, **new)
    assert trace.modalities == ("compass", "gps")
    assert trace.innovation is not None
    assert trace.innovation_covariance is not None
    assert trace.accepted is not None
    np.testing.assert_allclose(trace.innovation[:, 0, 0], np.radians([1.0, np.nan, -2.0, 3.0]), rtol=1e-6)
    assert np.isnan(trace.innovation[:, 0, 1]).all()
    np.testing.assert_allclose(trace.innovation[:, 1, 1], [0.0, 1.0, np.nan, 3.0])
    np.testing.assert_allclose(trace.innovation_covariance[0, 0, 0, 0], np.radians(3.0) ** 2, rtol=1e-6)
    np.testing.assert_allclose(trace.innovation_covariance[0, 1], [[4.0, 1.0], [1.0, 9.0]])
    np.testing.assert_array_equal(trace.accepted[:, 1], [1.0, 0.0, np.nan, 1.0])
    assert np.isnan(trace.accepted[:, 0]).all()


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ("compass = {innov", "sonar = {innov", "modality 'sonar' of [innovations] does not exist"),
        ('std = "sd_c", ', "", "innovations of 'compass' are {'innovation': 'nu_c', 'unit': 'deg'}, expected"),
        (
            'unit = "deg"}\ngps',
            'unit = "degrees"}\ngps',
            "unit of innovations of 'compass' is 'degrees', expected 'deg'",
        ),
        (
            'covariance = "S"',
            'covariance = "used"',
            "covariance of the innovations of 'gps' has 1 number per row, expected 4",
        ),
        ("[innov", 'weights = {gps = "used"}\n[innov', "'compass' of [innovations] has no fusion weight, unlike gps"),
    ],
)
def test_errors_name_the_modality(tmp_path: Path, old: str, new: str, error: str) -> None:
    with pytest.raises(BadInput, match=re.escape(error)):
        imported(tmp_path, MAP.replace(old, new))
