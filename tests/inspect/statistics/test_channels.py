"""Channels of imported sensors over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beliefscope.app.protocol.trace_format import columns as columns_of_page
from beliefscope.inspect.figures.timeline_charts import Chart, chart_names, chart_of
from beliefscope.inspect.statistics.channels import residual_channels
from beliefscope.recordings.log_readers.column_map import read_map
from beliefscope.recordings.log_readers.read_log import read_log, recorded_trace


def test_residuals_are_readings_minus_the_truth(tmp_path: Path) -> None:
    """Of channels with the name and unit of a component; differences of headings are wrapped."""
    t = np.arange(20.0)
    columns = {"t": t, "true_x": 0.3 * t, "true_yaw": np.where(t > 9, 179.0, -170.0)}
    columns |= {"gps_x": 30.0 * t + 5.0, "gps_y": 2.0 * t, "yaw": np.full(20, -179.0), "force_x": t, "force_y": t}
    columns["gps_x"][3] = columns["gps_y"][3] = np.nan
    text = """time = "t"
[state]
x = "true_x"
yaw = {column = "true_yaw", unit = "deg"}
[sensors]
gps = {column = ["gps_x", "gps_y"], unit = ["cm", "m"]}
yaw = {column = "yaw", unit = "deg"}
force = ["force_x", "force_y"]
[estimate]
mean = ["true_x", "true_yaw"]
"""
    (tmp_path / "map.toml").write_text(text)
    mapping = read_map(tmp_path / "map.toml")
    run = recorded_trace(columns, mapping, read_log(columns, mapping, "log"), 0, "log")
    residuals = residual_channels(run)
    assert {key: [c.name for c in own] for key, (_, own) in residuals.items()} == {
        "residual/gps": ["gps x"],
        "residual/yaw": ["yaw"],
    }
    expected = np.where(t == 3.0, np.nan, 0.05)
    np.testing.assert_allclose(residuals["residual/gps"][0][:, 0], expected, atol=1e-6)
    np.testing.assert_allclose(np.degrees(residuals["residual/yaw"][0][:, 0]), np.where(t > 9, 2.0, -9.0), atol=1e-4)
    assert "residual/gps" in chart_names(run)
    chart = chart_of("residual/gps", run, 0)
    assert isinstance(chart, Chart)
    assert (chart.title, chart.unit, [line.name for line in chart.series]) == ("Gps minus truth", "m", ["x"])
    np.testing.assert_allclose(chart.series[0].values, expected, atol=1e-6)
    assert {"residual/gps", "residual/yaw"} <= {description["name"] for description in columns_of_page(run)[0]}
