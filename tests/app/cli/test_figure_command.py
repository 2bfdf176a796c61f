"""The command figure."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

FAR = """
import numpy as np


def far():
    return estimate


def estimate(*, observations, controls):
    mean = observations["effector_position"][..., :2] + np.array([0.5, 0.0], np.float32)
    return mean, np.broadcast_to(np.eye(2, dtype=np.float32) * 1e-4, (*mean.shape, 2))
"""


@pytest.mark.slow
def test_an_estimate_outside_of_the_map_is_reported(run: Callable[..., Any], tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(FAR)
    filter_ = ("--filter", f"{tmp_path}/own.py:far", "--episode", 9)
    code, _, error = run("figure", "maps", "push", *filter_, "--step", 20, "-o", tmp_path / "maps.png")
    assert (code, "Warning: at step 20, the fused estimate is outside of the map" in error) == (0, True)


@pytest.mark.slow
def test_the_timeline_as_a_figure_and_as_values(run: Callable[..., Any], tmp_path: Path) -> None:
    arguments = (
        "figure",
        "timeline",
        "door",
        "--filter",
        "crossmodal-ekf",
        "--window",
        "20-24",
        "--component",
        "angle",
    )
    charts = ("--chart", "error", "--chart", "particles")
    code, _, error = run(*arguments, *charts, "-o", tmp_path / "timeline.csv")
    assert (code, "no chart particles: the filter has no particles" in error) == (0, True)
    header, *rows = (tmp_path / "timeline.csv").read_text().splitlines()
    assert (header.split(",")[4], len(rows)) == ("angle_error_fused_deg", 5)
    assert run(*arguments, "--beta", "--seconds", "-o", tmp_path / "timeline.pdf")[0] == 0
    assert (tmp_path / "timeline.pdf").read_bytes().startswith(b"%PDF")
