"""Files contain the definition of their task: every command and the server work without the file that defines it."""

from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from beliefscope.app.cli.main import main
from beliefscope.datasets.catalog import TASKS, load_task
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, write_dataset
from beliefscope.datasets.task import Component, Task
from beliefscope.datasets.task_json import task_to_json
from beliefscope.filters.batch import Steps
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import load_checkpoint, save_checkpoint
from beliefscope.inspect.trace import Trace, load_trace, save_trace, trace
from beliefscope.inspect.traces.live_file import load_live
from beliefscope.recordings.live import LiveRecorder
from beliefscope.recordings.read import read_recording
from beliefscope.recordings.write import write_recording

pytestmark = pytest.mark.slow

DEFINITION = """
import numpy as np
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.task import Component, Task

def simulate(seed, index, steps):
    rng = np.random.default_rng([seed, index])
    states = np.cumsum(rng.normal(0, 0.01, (steps, 2)), axis=0).astype(np.float32)
    gps = (states + rng.normal(0, 0.02, states.shape)).astype(np.float32)
    speed = rng.normal(0, 1, (steps, 1)).astype(np.float32)
    split = ("train", "val", "test")[index % 3]
    empty = np.zeros((steps, 0), np.float32)
    return Episode(TASK, states, speed, {"gps": gps, "sonar": gps - states}, speed[:, 0] > 0, empty, 0.2, seed, split)

TASK = Task("rover", (Component("x", "m"), Component("y", "m")), {"gps": (2,), "sonar": (2,)},
            {"satellite": ("gps",), "sound": ("sonar",)}, 1, 0.2, ("x", "y"), 0.4, simulate=simulate, warmup=0)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data, checkpoint, trace, recording and live run of a task whose definition is deleted."""
    folder = tmp_path_factory.mktemp("rover")
    source = folder / "rover.py"
    source.write_text(DEFINITION)
    task = load_task(f"{source}:TASK")
    assert "rover" not in TASKS
    assert task.simulate is not None
    episodes = [task.simulate(0, index, 30) for index in range(6)]
    write_dataset(folder / "data.h5", task, episodes)
    filter_ = build(architecture(task, "crossmodal-ekf"))
    filter_.statistics.fit(Steps.from_episodes(task, episodes))
    save_checkpoint(filter_.eval(), "crossmodal-ekf", {}, folder / "own.safetensors")
    run = trace(load_checkpoint(folder / "own.safetensors"), episodes[2], 2)
    save_trace(run, folder / "run.trace")
    write_recording(run, folder / "run.rrd")
    with LiveRecorder("live", task=f"{source}:TASK", folder=folder / "workspace" / "live", views=False) as live:
        for t, mean in enumerate(run.estimate_mean):
            observations = {key: values[t] for key, values in run.episode.observations.items()}
            live.step((mean, run.estimate_covariance[t]), observations, truth=run.episode.states[t])
    source.unlink()
    return folder


FRESH = """
import json, sys
from pathlib import Path
from starlette.testclient import TestClient
from beliefscope.app.cli.main import main
from beliefscope.app.runs.settings import Settings
from beliefscope.app.server.main import create_app

for arguments in json.loads(sys.argv[1]):
    sys.argv = ["beliefscope", *arguments]
    try:
        main()
    except SystemExit as end:
        assert not end.code, (arguments, end.code)
settings = Settings(Path("workspace"), {"mine": Path("data.h5")}, {"own": Path("own.safetensors")})
for served, run in ((settings, "own/2?data=mine"), (Settings(Path("workspace")), "own/0?data=live:live")):
    with TestClient(create_app(served, warm=False), base_url="http://localhost:8000") as client:
        entry = client.get("/api/live").json()["runs"][0]
        assert (entry["name"], entry["task"], entry["state"]) == ("live", "rover", "ended"), entry
        tasks = [task["name"] for task in client.get("/api/catalog").json()["tasks"]]
        assert ("rover" in tasks) == bool(served.data), tasks
        while (answer := client.get(f"/api/trace/rover/{run}")).status_code == 202:
            pass
        assert answer.status_code == 200, answer.text
        assert [c["name"] for c in answer.json()["components"]] == ["x", "y"]
print("served")
"""


@pytest.mark.long
def test_commands_and_server_need_no_definition(folder: Path) -> None:
    run = ["rover", "--filter", "own.safetensors", "--data", "data.h5"]
    commands = [
        ["inspect", "run.trace", "--only", "consistency"],
        ["inspect", "workspace/live/live.live", "--only", "consistency"],
        ["import", "run.rrd", "-o", "imported.trace"],
        ["export", "run.rrd", "-o", "run.npz"],
        ["evaluate", *run],
        ["trace", *run, "--episode", "2", "-o", "again.trace"],
        ["record", *run, "-o", "again.rrd"],
        ["change", "own.safetensors", "own.safetensors", "--data", "data.h5"],
        ["change", "own.safetensors", "own.safetensors", "--data", "data.h5", "--task", "rover"],
    ]
    result = subprocess.run(
        [sys.executable, "-c", FRESH, json.dumps(commands)],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.endswith("served\n")
    expected, again = load_trace(folder / "run.trace"), load_trace(folder / "again.trace")
    np.testing.assert_array_equal(again.estimate_mean, expected.estimate_mean)
    assert load_trace(folder / "imported.trace").task == again.task


def test_every_file_contains_the_definition(folder: Path) -> None:
    with open_dataset(folder / "data.h5") as data:
        expected = data.task
    assert (expected.name, expected.map_half_width, expected.simulate) == ("rover", 0.4, None)
    assert load_checkpoint(folder / "own.safetensors").task == expected
    assert load_trace(folder / "run.trace").task == expected
    assert read_recording(folder / "run.rrd").task == expected
    assert load_live(folder / "workspace" / "live" / "live.live").task == expected


def run(*arguments: object) -> str:
    """The standard error of a command that fails."""
    err = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stderr(err):
        patch.setattr(sys, "argv", ["beliefscope", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
    assert end.value.code == 2
    return err.getvalue()


def test_code_is_requested_in_one_line(folder: Path, tmp_path: Path) -> None:
    assert "task 'rover' does not exist" in run("collect", "rover", "-o", tmp_path / "a.h5")
    assert "FILE.py:NAME" in run("collect", "rover", "-o", tmp_path / "a.h5")
    other = tmp_path / "other.py"
    other.write_text(
        DEFINITION.replace('Component("y", "m")', 'Component("z", "m")').replace('("x", "y")', '("x", "z")')
    )
    message = run("inspect", folder / "run.trace", "--task", f"{other}:TASK")
    assert "run.trace is of a task with the same name 'rover' but other components" in message


def named_only(path: Path, target: Path) -> None:
    """Copy a trace as earlier versions wrote it, with the name of its task."""
    with safe_open(path, "np") as file:
        header = json.loads(file.metadata()["beliefscope-trace"])
    header["episode"]["task"] = header["episode"]["task"]["name"]
    save_file(load_file(path), target, metadata={"beliefscope-trace": json.dumps(header)})


def test_files_that_only_name_a_task(folder: Path, tmp_path: Path) -> None:
    named_only(folder / "run.trace", tmp_path / "old.trace")
    with pytest.raises(BadInput, match="task 'rover' does not exist"):
        load_trace(tmp_path / "old.trace")
    (tmp_path / "rover.py").write_text(DEFINITION)
    task = load_task(f"{tmp_path / 'rover.py'}:TASK")
    old = load_trace(tmp_path / "old.trace", [task])
    assert old.task is task
    new = load_trace(folder / "run.trace", [task])
    assert (new.task, new.task.simulate) == (task, task.simulate)


def recorded(task: Task, folder: Path, states: int) -> Trace:
    values: Mapping[str, Any] = {"estimate_mean": np.zeros(states), "estimate_covariance": np.eye(states)}
    with LiveRecorder("run", task=task, folder=folder / str(states), views=False) as live:
        live.step(values, {"gps": np.zeros(2), "sonar": np.zeros(2)})
    return load_live(live.path)


def test_tasks_with_the_same_name(tmp_path: Path) -> None:
    """Two definitions with one name, which is also that of a built-in task."""
    (tmp_path / "rover.py").write_text(DEFINITION)
    task = replace(load_task(f"{tmp_path / 'rover.py'}:TASK"), name="push")
    wider = replace(task, components=(*task.components, Component("heading", "rad")))
    before = dict(TASKS)
    first, second = (recorded(each, tmp_path, len(each.components)) for each in (task, wider))
    assert (len(first.task.components), len(second.task.components)) == (2, 3)
    assert task_to_json(second.task) == task_to_json(wider)
    assert first.task.simulate is None
    assert before == TASKS
    checkpoint = load_checkpoint(Path(__file__).parents[1] / "filters/pretrained/push-crossmodal-ekf.safetensors")
    with pytest.raises(BadInput, match="the episode is of a task with the same name 'push' but other observations"):
        trace(checkpoint, first.episode)
