"""The command ``diagnose``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from beliefscope.app.runs.settings import Settings
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset

pytestmark = pytest.mark.slow

Run = Callable[..., tuple[int, str, str]]


def test_too_few_clean_episodes_are_refused_before_the_runs(run: Run, base_settings: Settings) -> None:
    checkpoint, data = base_settings.checkpoints["crossmodal-pf"], base_settings.data["mine"]
    line = ["diagnose", "door", "--filter", checkpoint, "--data", data, "--profile-from", data, "--particles", 30]
    code, _, error = run(*line)
    assert code == 2
    assert "a healthy record of 1 episode, the held-out part of 2, is too small; measure it from at least 10" in error
    assert "Measuring the healthy record" not in error


OWN = "examples/04_own_filter.py:build"


@pytest.mark.parametrize(
    ("options", "clean"),
    [
        ("", "CLEAN.h5"),
        ("--episode 9", "CLEAN.h5"),
        ("--episode 9 --faults blackout", "datasets/samples/door.h5"),
        ("--episode 9 --data mine.h5 --faults blackout", "CLEAN.h5"),  # these episodes are too few
    ],
)
def test_the_command_that_measures_a_record_is_the_users(
    run: Run, base_settings: Settings, options: str, clean: str
) -> None:
    line = f"diagnose door --filter {OWN} {options}".replace("mine.h5", str(base_settings.data["mine"])).strip()
    code, _, error = run(line.replace("--episode 9 --data", "--episode 0 --data"))
    assert code == 2
    message, _, command = error.rpartition(": ")
    assert "no healthy record; measure it on clean data with 10 or more held-out episodes" in message
    assert message.endswith("(add --profile-filter OLD for that of an earlier version)")
    assert command.startswith("beliefscope diagnose door")
    assert command.rstrip().endswith(clean)


def test_a_small_record_has_no_low_alarm_rate(run: Run, tmp_path: Path) -> None:
    with open_dataset(sample_path("door")) as data:
        write_dataset(tmp_path / "clean.h5", data.task, [data[index] for index in data.held_out()[:12]])
    line = f"diagnose door --filter {OWN} --episode 9 --profile-from {tmp_path / 'clean.h5'} --alarm-rate 0.02"
    code, _, error = run(line)
    assert code == 2
    assert "needs 49; diagnose several episodes, or use a rate of 0.077 or more" in error


def test_a_workspace_keeps_the_record_for_later_diagnoses(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_dataset(sample_path("door")) as data:
        write_dataset(tmp_path / "clean.h5", data.task, [data[index] for index in data.held_out()[:12]])
    line = f"diagnose door --filter {OWN} --episode 9 --workspace {tmp_path / 'workspace'}"
    code, first, _ = run(f"{line} --profile-from {tmp_path / 'clean.h5'}")
    assert code == 0
    monkeypatch.setattr("beliefscope.inspect.healthy.profile_of", None)
    code, second, _ = run(line)
    assert (code, second.splitlines()[0]) == (0, first.splitlines()[0]), "nothing is measured again"
    code, _, error = run(f"diagnose door --filter {OWN} --episode 9 --workspace {tmp_path / 'other'}")
    assert (code, "no healthy record" in error) == (2, True)
