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
