"""The command ``diagnose``."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from beliefscope.app.runs.settings import Settings

pytestmark = pytest.mark.slow

Run = Callable[..., tuple[int, str, str]]


def test_too_few_clean_episodes_are_refused_before_the_runs(run: Run, base_settings: Settings) -> None:
    checkpoint, data = base_settings.checkpoints["crossmodal-pf"], base_settings.data["mine"]
    line = ["diagnose", "door", "--filter", checkpoint, "--data", data, "--profile-from", data, "--particles", 30]
    code, _, error = run(*line)
    assert code == 2
    assert "a healthy record of 1 episodes is too small; measure it from at least 10" in error
    assert "Measuring the healthy record" not in error
