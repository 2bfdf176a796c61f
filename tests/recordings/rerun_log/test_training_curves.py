"""How a fine-tuning goes, written look by look."""

from __future__ import annotations

from pathlib import Path

import pytest
from rerun.chunk import RrdReader

from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.rerun_log.training_curves import tuning_curves

LOOKS = {
    0: {"nominal/position_cm": 0.5, "dark touch/position_cm": 2.0},
    25: {"nominal/position_cm": 0.25, "loss": 0.125},
}


def values(path: Path, entity: str) -> dict[int, float]:
    """Step -> number of a path of the file."""
    found: dict[int, float] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == f"/tuning/{entity}" and "Scalars:scalars" in batch.schema.names:
            steps, numbers = batch.column("step").to_pylist(), batch.column("Scalars:scalars").to_pylist()
            found |= {step: number[0] for step, number in zip(steps, numbers, strict=True)}
    return found


def test_every_look_is_in_the_file_at_its_step(tmp_path: Path) -> None:
    with tuning_curves(tmp_path) as write:
        for step, numbers in LOOKS.items():
            write(step, numbers)
    path = tmp_path / "run-1.rrd"
    assert values(path, "position_cm/nominal") == {0: 0.5, 25: 0.25}
    assert values(path, "position_cm/dark_touch") == {0: 2.0}
    assert values(path, "loss/run") == {25: 0.125}


def test_a_run_that_goes_on_writes_a_file_of_the_same_recording(tmp_path: Path) -> None:
    for step, numbers in LOOKS.items():
        with tuning_curves(tmp_path) as write:
            write(step, numbers)
    first, second = (RrdReader(tmp_path / f"run-{i}.rrd") for i in (1, 2))
    assert values(tmp_path / "run-2.rrd", "position_cm/nominal") == {25: 0.25}
    assert [r.recording_id for r in first.recordings()] == [r.recording_id for r in second.recordings()]


def test_what_is_no_address_is_refused_and_nothing_written(tmp_path: Path) -> None:
    with (
        pytest.raises(BadInput, match="'nowhere' is no address of a Rerun viewer"),
        tuning_curves(tmp_path / "new", "nowhere"),
    ):
        pass
    assert not list(tmp_path.iterdir())
