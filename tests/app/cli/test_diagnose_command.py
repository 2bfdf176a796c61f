"""The command ``diagnose``."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from beliefscope.app.runs.settings import Settings

pytestmark = pytest.mark.slow

Run = Callable[..., tuple[int, str, str]]


def test_progress_of_measuring_the_healthy_record(run: Run, base_settings: Settings) -> None:
    checkpoint, data = base_settings.checkpoints["crossmodal-pf"], base_settings.data["mine"]
    line = ["diagnose", "door", "--filter", checkpoint, "--data", data, "--profile-from", data, "--particles", 30]
    code, _, error = run(*line)
    assert code == 2
    assert "Measuring the healthy record" in error
    assert "a healthy record of 1 episodes cannot show a fault" in error
