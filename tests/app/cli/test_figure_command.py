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


EXAMPLE = Path(__file__).parents[3] / "examples" / "04_own_filter.py"


@pytest.mark.slow
def test_a_recorded_run_has_the_figures_of_the_run(run: Callable[..., Any], tmp_path: Path) -> None:
    selection = ("door", "--filter", "crossmodal-ekf", "--episode", 9)
    assert run("trace", *selection, "-o", tmp_path / "run.trace")[0] == 0
    assert run("figure", "timeline", *selection, "-o", tmp_path / "timeline.csv")[0] == 0
    code, text, _ = run("figure", "timeline", tmp_path / "run.trace", "-o", tmp_path / "recorded.csv")
    assert (code, "crossmodal-ekf over 100 steps of door episode 9" in text) == (0, True)
    assert (tmp_path / "recorded.csv").read_bytes() == (tmp_path / "timeline.csv").read_bytes()
    assert run("figure", "maps", tmp_path / "run.trace", "--step", 20, "-o", tmp_path / "maps.png")[0] == 0
    for arguments, message in (
        ((tmp_path / "run.trace", "--faults", "blackout=0.4"), "a recorded run is drawn as it is"),
        ((tmp_path,), "is a folder; give one of its runs"),
        ((tmp_path / "run.trace", "--filter", "image-ekf"), "is a run of crossmodal-ekf, checkpoint"),
        ((tmp_path / "run.trace", "--filter", f"{EXAMPLE}:build"), "04_own_filter.py:build'\n"),
        (("door",), "--filter is missing"),
    ):
        code, _, error = run("figure", "weights", *arguments, "-o", tmp_path / "weights.png")
        assert (code, message in error) == (2, True), error
