"""The command sweep."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file

from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.checkpoint import pretrained_path
from beliefscope.recordings.experiments import Experiments


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
    monkeypatch.setattr("beliefscope.recordings.experiments.SHOWN", 1)
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


OWN = """
import torch
from torch import nn


class Own(nn.Module):
    task = "push"

    def __init__(self):
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(2))

    def forward(self, *, observations, controls):
        return observations["effector_position"][..., :2] + self.bias
"""


def test_weights_of_an_external_filter_are_a_pattern(
    run: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each has its own row, with the provenance beside it; paths are absolute, since others read the table."""
    monkeypatch.chdir(tmp_path)
    Path("own.py").write_text(OWN)
    Path("runs").mkdir()
    for step in (0, 100):
        save_file({"bias": np.full(2, 0.001 * step, np.float32)}, f"runs/{step}.safetensors")
        Path(f"runs/{step}.json").write_text(json.dumps({"step": step}))
    with open_dataset(sample_path("push")) as data:
        write_dataset(Path("push.h5"), data.task, [data[9]])
    sweep = ("sweep", "--checkpoints", "own.py:Own@runs/*.safetensors", "--data", "push.h5", "--json", "-")
    code, out, _ = run(*sweep, "-o", "sweep")
    rows = {row["name"]: row for row in json.loads(out)["overview"]}
    assert (code, [*rows]) == (0, ["100", "0"])
    assert [row["filter"] for row in rows.values()] == ["own-Own"] * 2
    assert [json.loads(row["provenance"]) for row in rows.values()] == [{"step": 100}, {"step": 0}]
    (path,) = Experiments([Path("sweep")]).query("SELECT path FROM checkpoints WHERE name = '0'").column(0).to_pylist()
    assert path == f"{tmp_path}/own.py:Own@{tmp_path}/runs/0.safetensors"
    code, _, error = run("sweep", "--checkpoints", "own.py:Own@other/*.safetensors", "-o", "sweep")
    assert (code, "no checkpoint (.safetensors) matches 'other/*.safetensors'" in error) == (2, True)
    for name in ("bad", "worse"):
        save_file({"other": np.zeros(2, np.float32)}, f"runs/{name}.safetensors")
    code, _, error = run(*sweep, "-o", "sweep", "--skip-bad")
    assert (code, error.count("skipped: "), "Warning" in error) == (0, 1, False)
    reason = 'Missing key(s) in state_dict: "bias", and 1 more (the same: worse.safetensors)'
    assert reason in " ".join(error.split())
