"""The command sweep."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.checkpoint import pretrained_path


@pytest.mark.slow
def test_checkpoints_without_data_of_their_task_are_named(run: Callable[..., Any], tmp_path: Path) -> None:
    with open_dataset(sample_path("push")) as data:
        write_dataset(tmp_path / "push.h5", data.task, [data[9]])
    paths = [pretrained_path(task, "image-ekf") for task in ("push", "door")]
    arguments = [part for path in paths for part in ("--checkpoints", path)]
    code, _, error = run("sweep", *arguments, "--data", tmp_path / "push.h5", "-o", tmp_path / "sweep")
    assert code == 0
    assert "Warning: no data of their tasks, or copies of other checkpoints: door-image-ekf.safetensors" in error


def test_the_largest_errors_are_printed(
    run: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("beliefscope.recordings.sweep_table.SHOWN", 1)
    with open_dataset(sample_path("push")) as data:
        write_dataset(tmp_path / "push.h5", data.task, [data[9]])
    arguments = ["--checkpoints", pretrained_path("push", "haptics-ekf"), "--data", tmp_path / "push.h5"]
    faults = ["--faults", "blackout=0.4", "--faults", "blackout=0.8"]
    code, out, _ = run("sweep", *arguments, *faults, "-o", tmp_path / "sweep")
    assert code == 0
    assert out.count("haptics-ekf") == 2, "name and filter of one row"
    assert f"1 more row: beliefscope experiments {tmp_path / 'sweep'} --top 2" in out


def test_unusable_checkpoints_are_listed_and_can_be_skipped(run: Callable[..., Any], tmp_path: Path) -> None:
    with open_dataset(sample_path("push")) as data:
        write_dataset(tmp_path / "push.h5", data.task, [data[9]])
    good = Path(shutil.copy(pretrained_path("push", "image-ekf"), tmp_path / "good.safetensors"))
    (tmp_path / "truncated.safetensors").write_bytes(good.read_bytes()[:1000])
    (tmp_path / "text.safetensors").write_text("no checkpoint")
    sweep = ("sweep", "--checkpoints", tmp_path / "*.safetensors", "--data", tmp_path / "push.h5")
    code, _, error = run(*sweep, "-o", tmp_path / "sweep")
    assert code == 2
    assert "2 of 3 checkpoints are unusable" in error
    assert all(text in error for text in ("text.safetensors", "truncated.safetensors", "--skip-bad"))
    assert not (tmp_path / "sweep").exists()
    code, out, error = run(*sweep, "-o", tmp_path / "sweep", "--skip-bad", "--json", "-")
    assert code == 0
    assert error.count("skipped: ") == 2
    assert [row["name"] for row in json.loads(out)["overview"]] == ["good"]
    good.unlink()
    code, _, error = run(*sweep, "-o", tmp_path / "other", "--skip-bad")
    assert (code, "2 of 2 checkpoints are unusable" in error) == (2, True)
