"""Curves of a fine-tuning run, written validation by validation."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from rerun.chunk import RrdReader

from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.rerun_log.training_curves import log_curves, tuning_curves

VALIDATIONS = {
    0: {"clean/position_cm": 0.5, "dark touch/position_cm": 2.0},
    25: {"clean/position_cm": 0.25, "loss": 0.125},
}


def values(path: Path, entity: str) -> dict[int, float]:
    """Step -> value of an entity in the file."""
    result: dict[int, float] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == f"/tuning/{entity}" and "Scalars:scalars" in batch.schema.names:
            steps, numbers = batch.column("step").to_pylist(), batch.column("Scalars:scalars").to_pylist()
            result |= {step: number[0] for step, number in zip(steps, numbers, strict=True)}
    return result


def test_file_contains_every_validation(tmp_path: Path) -> None:
    with tuning_curves(tmp_path) as write:
        for step, numbers in VALIDATIONS.items():
            write(step, numbers)
    path = tmp_path / "run-1.rrd"
    assert values(path, "position_cm/clean") == {0: 0.5, 25: 0.25}
    assert values(path, "position_cm/dark_touch") == {0: 2.0}
    assert values(path, "loss/run") == {25: 0.125}


def test_resumed_run_writes_another_file_of_the_same_recording(tmp_path: Path) -> None:
    for step, numbers in VALIDATIONS.items():
        with tuning_curves(tmp_path) as write:
            write(step, numbers)
    first, second = (RrdReader(tmp_path / f"run-{i}.rrd") for i in (1, 2))
    assert values(tmp_path / "run-2.rrd", "position_cm/clean") == {25: 0.25}
    assert [r.recording_id for r in first.recordings()] == [r.recording_id for r in second.recordings()]


def test_invalid_viewer_address_writes_nothing(tmp_path: Path) -> None:
    with (
        pytest.raises(BadInput, match="'nowhere' is not the address of a Rerun viewer"),
        tuning_curves(tmp_path / "new", "nowhere"),
    ):
        pass
    assert not list(tmp_path.iterdir())


def test_tensorboard_is_optional(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    warnings: list[str] = []
    with log_curves(tmp_path, warn=warnings.append) as write:
        write(0, {"loss": 0.5})
    assert values(tmp_path / "run-1.rrd", "loss/run") == {0: 0.5}
    assert len(warnings) == 1
    assert "pip install 'beliefscope[tensorboard]'" in warnings[0]
