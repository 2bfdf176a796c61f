"""The command sweep."""

from __future__ import annotations

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
