"""What there is to show of each task: given files before those that ship, under names that tell them apart."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from beliefscope.app.runs.catalog import SAMPLE, shelves, short_names
from beliefscope.app.server.main import Settings
from beliefscope.datasets.catalog import TASKS
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import write_dataset
from beliefscope.datasets.task import Task
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import save_checkpoint

MIT = Path(__file__).resolve().parents[4] / "shared" / "data" / "mit_push"


def test_names_are_short_and_tell_files_apart(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a/x/pf.safetensors", "b/x/pf.safetensors", "b/ekf.safetensors", "b/lstm")]
    (tmp_path / "b" / "lstm.v2").mkdir(parents=True)
    paths += [tmp_path / "b" / "lstm.v2", tmp_path / "b" / "x" / ".." / "ekf.safetensors"]
    names = short_names(paths, taken={"lstm"})
    assert list(names) == ["a-x-pf", "b-x-pf", "ekf", "b-lstm", "lstm.v2"]
    assert names["a-x-pf"] == paths[0]


def test_given_files_come_before_those_that_ship(given: Settings) -> None:
    found, problems = shelves({"own": given.checkpoints["crossmodal-ekf"]}, given.data)
    assert problems == []
    assert [*found] == [*TASKS]
    door = found["door"]
    assert [*door.filters][:3] == ["own", "crossmodal-pf", "crossmodal-ekf"]
    assert [*door.data] == ["mine", SAMPLE]
    assert door.dataset("") is door.data["mine"]


def test_a_line_for_each_thing_that_cannot_be_shown(
    given: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bare = foreign_task(monkeypatch)
    simulate = DOOR.simulate
    assert simulate is not None
    write_dataset(tmp_path / "bare.h5", bare, [replace(simulate(0, 0, 10), task=bare.name)])
    save_checkpoint(build(architecture(bare.name, "image-ekf")), "image-ekf", {}, tmp_path / "bare.safetensors")
    missing = tmp_path / "missing"
    _, problems = shelves({"a": missing}, {"b": missing, "c": tmp_path / "bare.h5"})
    assert problems == [
        f"checkpoint {str(missing)!r} does not exist",
        f"{missing} does not exist.",
        "no trained filter of task 'bare' is there to show; give one: --filter FILE",
    ]
    found, problems = shelves({"a": tmp_path / "bare.safetensors"}, {})
    assert problems == ["no set of episodes of task 'bare' is there to show; give one: --data FILE"]
    found, problems = shelves({"a": tmp_path / "bare.safetensors"}, {"c": tmp_path / "bare.h5"})
    assert problems == []
    assert next(iter(found)) == "bare"


@pytest.mark.skipif(not MIT.is_dir(), reason="the pushes of the MIT data set are not beside the project")
def test_pushes_are_episodes_of_each_task_that_filters_were_given_for(tmp_path: Path) -> None:
    first = min(MIT.rglob("*.json"))
    for name in ("push-real", "push-real-yaw"):
        save_checkpoint(build(architecture(name, "image-ekf")), "image-ekf", {}, tmp_path / f"{name}.safetensors")
    found, problems = shelves({"own": tmp_path / "push-real-yaw.safetensors"}, {"pushes": first})
    assert problems == []
    assert found["push-real-yaw"].data["pushes"].task is TASKS["push-real-yaw"]
    both = {name: tmp_path / f"{name}.safetensors" for name in ("push-real", "push-real-yaw")}
    found, problems = shelves(both, {"pushes": first})
    assert problems == []
    assert all(found[name].data["pushes"].task is TASKS[name] for name in both)


def foreign_task(monkeypatch: pytest.MonkeyPatch) -> Task:
    """A task that ships nothing."""
    task = replace(DOOR, name="bare")
    monkeypatch.setitem(TASKS, task.name, task)
    return task
