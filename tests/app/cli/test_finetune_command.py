"""The command ``finetune`` on sample sets without training episodes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.checkpoint import load_checkpoint
from beliefscope.filters.finetuning import training_data

pytestmark = pytest.mark.slow

Run = Callable[..., tuple[int, str, str]]


@pytest.mark.long
def test_training_episodes_of_a_field_task_are_simulated(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the page does: so the command that a diagnosis suggests runs."""
    monkeypatch.setattr(training_data, "EPISODES", 3)
    output = tmp_path / "tuned.safetensors"
    line = "finetune push-field --filter information-ekf --faults image_noise=40 --steps 1 --length 8 -o"
    code, _, error = run(line, output)
    assert code == 0, error
    assert "Simulating 3 training episodes of push-field" in error
    with open_dataset(tmp_path / "push-field-train.h5") as simulated:
        assert len(simulated) == 3
    assert load_checkpoint(output).healthy_profile is not None


@pytest.mark.long
def test_events_of_other_data_need_no_training_episodes(
    run: Run, tmp_path: Path, short_episodes: Callable[..., list[Episode]]
) -> None:
    """Episodes with events are trained on, whatever their split; nothing is simulated for the user's own data."""
    with open_dataset(sample_path("push-field")) as sample:
        task, indices = sample.task, sample.held_out()[:3]
    write_dataset(tmp_path / "own.h5", task, short_episodes(task.name, indices, 65))
    output, data = tmp_path / "tuned.safetensors", tmp_path / "own.h5"
    line = "finetune push-field --filter information-ekf --event 0:10-60 --steps 1 --length 8 --data"
    code, out, error = run(line, data, "-o", output)
    assert code == 0, error
    assert "Simulating" not in error
    assert error.startswith("Encoding images and evaluating the base checkpoint")
    assert "On windows of held-out episodes" in out
    assert f"beliefscope change information-ekf {output} --task push-field --data {data}" in out
    assert output.is_file()
    assert [path.name for path in tmp_path.glob("*.partial")] == []


def test_training_from_scratch_needs_collected_episodes(run: Run, tmp_path: Path) -> None:
    code, _, error = run("train push-field --filter information-ekf -o", tmp_path / "new.safetensors")
    assert code == 2
    assert "beliefscope collect push-field -o push-field.h5" in error
