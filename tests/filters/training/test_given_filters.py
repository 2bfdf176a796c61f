"""Given checkpoints and external filters in a study: evaluated only, beside trained filters."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from beliefscope.app.cli.main import main
from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.checkpoint import PRETRAINED, load_checkpoint
from beliefscope.filters.training.study import held_out, study_cells
from beliefscope.filters.training.study_table import OFFSET, TRUTH
from beliefscope.filters.training.train import measure

pytestmark = pytest.mark.slow

GIVEN = PRETRAINED / "door-haptics-ekf.safetensors"
CODE = f"{Path(__file__).parents[3] / 'examples' / '04_own_filter.py'}:build"


@pytest.fixture
def words(tmp_path: Path, short_episodes: Callable[..., list[Episode]], monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Command line without the output; figures are not drawn."""
    with open_dataset(sample_path("door")) as dataset:
        indices = [next(e.index for e in dataset.summaries if e.split == split) for split in ("train", "val", "test")]
    write_dataset(tmp_path / "door.h5", find_task("door"), short_episodes("door", indices, 45))
    monkeypatch.setattr("beliefscope.recordings.study_figures.write_results", lambda rows, folder, tasks: [])
    filters = ["--filter", str(GIVEN), "--filter", CODE]
    return ["study", "--preset", "smoke", "--task", "door", "--data", f"door={tmp_path / 'door.h5'}", *filters]


def run(words: list[str], output: Path) -> int:
    """Exit code of a command line."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["beliefscope", *words, "-o", str(output)])
        with pytest.raises(SystemExit) as end:
            main()
    return int(end.value.code or 0)


def test_given_filters_are_rows(words: list[str], tmp_path: Path) -> None:
    """A checkpoint has the metrics of the evaluation after a training; an external filter needs no checkpoint file."""
    folder = tmp_path / "study" / "cells" / "door"
    assert run(words, tmp_path / "study") == 0
    cells = {path.parent.name: json.loads(path.read_text()) for path in folder.glob("*/seed0.json")}
    with open_dataset(tmp_path / "door.h5") as data:
        expected = measure(load_checkpoint(GIVEN).filter, held_out(list(data)))
    assert cells["door-haptics-ekf"][TRUTH] == json.loads(json.dumps(expected))
    assert 0.0 < cells["04_own_filter-build"][OFFSET]["0"]["fused"]["rmse"]["angle_deg"] < 30.0
    assert [path.parent.name for path in folder.glob("*/*.safetensors")] == ["door-haptics-ekf"]
    assert "| 04_own_filter-build | 80% | 1 of 1 |" in (tmp_path / "study" / "table.md").read_text()
    times = [path.stat().st_mtime_ns for path in sorted(folder.glob("*/*.json"))]
    assert run(words, tmp_path / "study") == 0
    assert times == [path.stat().st_mtime_ns for path in sorted(folder.glob("*/*.json"))], "evaluated again"


def test_filters_of_other_tasks_and_equal_names_are_refused(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([*words, "--filter", str(PRETRAINED / "push-crossmodal-ekf.safetensors")], tmp_path / "study") == 2
    assert "is for task 'push', not for 'door'" in capsys.readouterr().err
    given = [str(GIVEN), str(PRETRAINED / "push-crossmodal-ekf.safetensors")]
    cells = study_cells("smoke", ["door", "push"], given, 1, {"door": tmp_path / "door.h5"})
    assert [str(cell) for cell in cells] == ["door/door-haptics-ekf/seed0", "push/push-crossmodal-ekf/seed0"]
    (tmp_path / "lstm.safetensors").write_bytes(GIVEN.read_bytes())
    assert run([*words, "--filter", str(tmp_path / "lstm.safetensors")], tmp_path / "study") == 2
    assert "which another filter of the study is; rename it" in capsys.readouterr().err
