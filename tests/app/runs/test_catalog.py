"""Catalog of filters and data sets: order, short names, unusable inputs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from beliefscope.app.cli.commands.serve import Served
from beliefscope.app.runs.catalog import SAMPLE, served_names, short_names, task_catalogs
from beliefscope.app.runs.settings import Settings
from beliefscope.datasets.catalog import TASKS
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import write_dataset
from beliefscope.datasets.task import Task
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import save_checkpoint

pytestmark = pytest.mark.slow

MIT_PUSH = Path(__file__).resolve().parents[4] / "shared" / "data" / "mit_push"


def test_names_are_short_and_unique(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a/x/pf.safetensors", "b/x/pf.safetensors", "b/ekf.safetensors", "b/lstm")]
    (tmp_path / "b" / "lstm.v2").mkdir(parents=True)
    paths += [tmp_path / "b" / "lstm.v2", tmp_path / "b" / "x" / ".." / "ekf.safetensors"]
    names = short_names(paths, reserved={"lstm"})
    assert list(names) == ["a-x-pf", "b-x-pf", "ekf", "b-lstm", "lstm.v2"]
    assert names["a-x-pf"] == paths[0]


def test_permalinks_name_filters_as_the_server_does(tmp_path: Path, base_settings: Settings) -> None:
    """Files, and build functions with and without weights."""
    weights, code = tmp_path / "step-3.safetensors", tmp_path / "own.py"
    code.write_text(
        "from torch import nn\n\n\nclass Own(nn.Module):\n    task = 'door'\n\n"
        "    def __init__(self):\n        super().__init__()\n        self.linear = nn.Linear(1, 1)\n\n"
        "    def forward(self, *, observations, controls):\n        return controls[..., :3]\n"
    )
    save_file({"linear.weight": np.zeros((1, 1), np.float32), "linear.bias": np.zeros(1, np.float32)}, weights)
    filters = [f"{code}:Own", f"{code}:Own@{weights}", str(base_settings.checkpoints["crossmodal-ekf"])]
    served = Served(task=None, data=None, filter=filters).settings(tmp_path)
    names, data = served_names(filters, None)
    assert names == [*served.checkpoints]
    assert names[:2] == ["own-Own", "own-Own-step-3"]
    assert data == SAMPLE


def test_user_files_precede_the_included_ones(base_settings: Settings) -> None:
    catalogs, problems = task_catalogs({"own": base_settings.checkpoints["crossmodal-ekf"]}, base_settings.data)
    assert problems == []
    assert [*catalogs] == [*TASKS]
    door = catalogs["door"]
    assert [*door.filters][:3] == ["own", "crossmodal-pf", "crossmodal-ekf"]
    assert [*door.data] == ["mine", SAMPLE]
    assert door.dataset("") is door.data["mine"]


def test_each_unusable_input_is_reported_in_one_line(tmp_path: Path) -> None:
    bare = task_without_files()
    simulate = DOOR.simulate
    assert simulate is not None
    write_dataset(tmp_path / "bare.h5", bare, [replace(simulate(0, 0, 10), task=bare)])
    save_checkpoint(build(architecture(bare, "image-ekf")), "image-ekf", {}, tmp_path / "bare.safetensors")
    missing = tmp_path / "missing"
    _, problems = task_catalogs({"a": missing}, {"b": missing, "c": tmp_path / "bare.h5"})
    assert problems == [
        f"checkpoint {str(missing)!r} does not exist",
        f"{missing} does not exist",
        "task 'bare' has no trained filter; add one with --filter FILE",
    ]
    catalogs, problems = task_catalogs({"a": tmp_path / "bare.safetensors"}, {})
    assert problems == ["task 'bare' has no episodes; add a data set with --data FILE"]
    catalogs, problems = task_catalogs({"a": tmp_path / "bare.safetensors"}, {"c": tmp_path / "bare.h5"})
    assert problems == []
    assert next(iter(catalogs)) == "bare"


@pytest.mark.skipif(not MIT_PUSH.is_dir(), reason="requires the MIT Push data set next to the repository")
def test_a_file_is_listed_for_each_task_with_user_filters(tmp_path: Path) -> None:
    first = min(MIT_PUSH.rglob("*.json"))
    for name in ("push-real", "push-real-yaw"):
        save_checkpoint(build(architecture(name, "image-ekf")), "image-ekf", {}, tmp_path / f"{name}.safetensors")
    catalogs, problems = task_catalogs({"own": tmp_path / "push-real-yaw.safetensors"}, {"pushes": first})
    assert problems == []
    assert catalogs["push-real-yaw"].data["pushes"].task is TASKS["push-real-yaw"]
    both = {name: tmp_path / f"{name}.safetensors" for name in ("push-real", "push-real-yaw")}
    catalogs, problems = task_catalogs(both, {"pushes": first})
    assert problems == []
    assert all(catalogs[name].data["pushes"].task is TASKS[name] for name in both)


def task_without_files() -> Task:
    """A task without pretrained filters and sample data."""
    return replace(DOOR, name="bare")
