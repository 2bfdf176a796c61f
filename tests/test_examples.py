"""The examples run as documented, including a user-defined task in every part of the program."""

from __future__ import annotations

import contextlib
import io
import json
import re
import runpy
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import beliefscope as bs
from beliefscope.app.cli.main import main
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.datasets.catalog import TASKS, load_task
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.trace import load_trace, trace
from beliefscope.inspect.traces.live_file import load_live

pytestmark = pytest.mark.slow

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "own_task.py"
SPEC = f"{EXAMPLE}:TASK"


def run(*arguments: object) -> tuple[int, str, str]:
    """Run a command line; return exit code, standard output and standard error."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["beliefscope", *map(str, arguments)])
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), pytest.raises(SystemExit) as end:
            main()
    return int(end.value.code or 0), out.getvalue(), err.getvalue()


def result(*arguments: object) -> Any:
    code, out, err = run(*arguments, "--json", "-")
    assert code == 0, err
    return json.loads(out)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Data, a filter, a trace and a recording of the user-defined task."""
    folder = tmp_path_factory.mktemp("own")
    data, trained = folder / "own.h5", folder / "own.safetensors"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(EXAMPLE), str(data)])
        runpy.run_path(str(EXAMPLE), run_name="__main__")
    result("train", SPEC, "--filter", "crossmodal-ekf", "--data", data, "--preset", "smoke", "-o", trained)
    for command, name in (("trace", "own.trace"), ("record", "own.rrd")):
        result(command, SPEC, "--filter", trained, "--data", data, "-o", folder / name)
    return folder


def example(name: str, argument: object, capsys: pytest.CaptureFixture[str]) -> str:
    """Output of a numbered example."""
    path = EXAMPLE.parent / name
    assert len(path.read_text().splitlines()) < 40
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(path), str(argument)])
        runpy.run_path(str(path), run_name="__main__")
    return capsys.readouterr().out


@pytest.mark.long
def test_diagnose(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = example("01_diagnose.py", tmp_path, capsys)
    assert all(f"{entry.title}. {entry.question}\n  " in output for entry in DIAGNOSTICS.values())
    assert "; oracle: " in output
    assert "95 % interval -" in output, "five trajectories are enough for intervals"
    assert {path.stem for path in tmp_path.glob("*.pdf")} == {"weights", "consistency", "errors", "particles"}


@pytest.mark.long
def test_counterfactual(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = example("02_counterfactual.py", tmp_path / "what.svg", capsys)
    blackout, trusted, _ = re.findall(r"during the intervention: ([\d.]+) -> ([\d.]+) cm", output)
    assert blackout[0] == trusted[0], "both are compared with the same run"
    assert float(blackout[1]) < float(trusted[1]), "trusting a blacked out image increases the error"
    assert (tmp_path / "what.svg").read_text().startswith("<?xml")


@pytest.mark.long
def test_live(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    output = example("05_live.py", tmp_path, capsys)
    assert output == f"{tmp_path}/live/example.live: 100 steps, the hinge is at (81.0, -19.8) cm\n"
    checkpoint = load_checkpoint(pretrained_path("door", "crossmodal-ekf"))
    with open_dataset(sample_path("door")) as data:
        expected = trace(checkpoint, data[9])
    result = load_live(tmp_path / "live" / "example.live")
    # Encoding images one by one changes the order of floating-point sums.
    np.testing.assert_allclose(result.estimate_mean, expected.estimate_mean, atol=1e-5)


def test_example_is_short() -> None:
    assert len(EXAMPLE.read_text().splitlines()) < 60


@pytest.mark.long
def test_user_task_on_the_command_line(folder: Path) -> None:
    measured = result("evaluate", SPEC, "--filter", folder / "own.safetensors", "--data", folder / "own.h5")
    assert set(measured["rmse"]) == {"x_cm", "y_cm", "position_cm"}
    with open_dataset(folder / "own.h5") as data:
        assert measured["data_hash"] == data.hash
        traced = load_trace(folder / "own.trace")
        assert traced.data_hash == data[data.held_out()[0]].digest()
    assert traced.modalities == ("image", "sound")
    assert (folder / "own.rrd").stat().st_size > 10_000


@pytest.mark.long
def test_user_task_in_the_server(folder: Path, tmp_path: Path) -> None:
    store = TraceStore(Settings(tmp_path, {"own": folder / "own.h5"}, {"own": folder / "own.safetensors"}))
    try:
        catalog = store.catalog()
        assert catalog["problems"] == []
        task = catalog["tasks"][0]
        assert (task["name"], len(task["data"][0]["episodes"])) == ("ball", 100)
        assert [filter_["name"] for filter_ in task["filters"]] == ["own"]
        assert store.default_selection() == Selection("ball", "own", 9, data="own")
        run_ = store.request(store.default_selection())
        assert run_.trace.modalities == ("image", "sound")
        assert len(run_.columns[1]) > 0
        assert run_.map(3, 41).layers == ("image", "sound", "fused")
    finally:
        store.close()


def test_a_heading_that_wraps_around(tmp_path: Path) -> None:
    example, data, trained = EXAMPLE.parent / "mobile_robot.py", tmp_path / "robot.h5", tmp_path / "robot.safetensors"
    bs.save_dataset([episode := runpy.run_path(str(example))["drive"](0), *([episode] * 2)], data)
    assert bool((np.abs(np.diff(episode.states[:, 2])) > np.pi).any()), "the heading wraps around"
    code, _, err = run(
        "train", f"{example}:TASK", "--filter", "crossmodal-ekf", "--data", data, "--preset", "smoke", "-o", trained
    )
    assert (code, "wraps around" in err) == (0, False), err
    checkpoint = load_checkpoint(trained)
    mean, std = (value.tolist() for value in checkpoint.filter.statistics.mean_std("state"))
    assert (mean[2], std[2]) == (0.0, 1.0)
    estimate = trace(checkpoint, episode).estimate_mean[:, 2]
    assert bool((np.abs(estimate) <= np.pi + 1e-5).all())


def test_filters_of_unknown_tasks_are_rejected(folder: Path) -> None:
    code, _, err = run("evaluate", "door", "--filter", folder / "own.safetensors")
    assert code == 2
    assert "own.safetensors' is for task 'ball', not for 'door'" in err
    code, _, err = run("trace", "ball", "--filter", "crossmodal-ekf", "-o", folder / "no.trace")
    assert code == 2
    assert "task 'ball' does not exist. Available: door, " in err
    assert "Give a task of your own as FILE.py:NAME." in err
    _, _, err = run("evaluate", SPEC, "--filter", folder / "own.safetensors")
    assert "Task 'ball' has no sample set. Give its data with --data." in err


TASK_FILE = """
from beliefscope.datasets.task import Component, Task
NUMBER = 3
TASK = Task(
    name="{name}", components=(Component("x", "m"), Component("y", "m")),
    observations={{"image": (8, 8), "felt": (2,)}}, modalities={{"image": ("image",), "haptics": {keys}}},
    control_size=1, dt=0.1, map_components=("x", "{y}"),
    map_half_width=0.1,
)
"""


@pytest.mark.parametrize(
    ("content", "spec", "message"),
    [
        ("", "nothing.py:TASK", r"nothing\.py does not exist"),
        ("", "own.py:TASK", r"own\.py has no task 'TASK'\. Available: none\."),
        (TASK_FILE, "own.py:NUMBER", r"own\.py has no task 'NUMBER'\. Available: TASK\."),
        ("1 / 0", "own.py:TASK", r"own\.py cannot be run: ZeroDivisionError: division by zero"),
        ("def", "own.py:TASK", r"own\.py cannot be run: SyntaxError"),
        ("", "no.such.module:TASK", r"module 'no\.such\.module' cannot be imported: ModuleNotFoundError: No module"),
        ("", "json:TASK", r"json has no task 'TASK'"),
        (TASK_FILE, "own.py:TASK|a b", r"own\.py:TASK is named 'a b', expected a name without spaces"),
        (TASK_FILE, "own.py:TASK||('touch',)", r"modality 'haptics' has 'touch', which is not an observation"),
        (TASK_FILE, "own.py:TASK||()", r"modality 'haptics' has no observations"),
        (TASK_FILE, "own.py:TASK||('felt',)|z", r"component 'z' of task 'mine' does not exist\. Available: x, y"),
    ],
)
def test_invalid_tasks_are_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str, spec: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    spec, name, keys, y, *_ = [*spec.split("|"), "", "", ""]
    (tmp_path / "own.py").write_text(content.format(name=name or "mine", keys=keys or "('felt',)", y=y or "y"))
    before = dict(TASKS)
    with pytest.raises(BadInput, match=message):
        load_task(spec)
    assert before == TASKS


@pytest.mark.long
def test_study_of_a_user_task_without_images(folder: Path, tmp_path: Path) -> None:
    script, data = tmp_path / "sound.py", tmp_path / "sound.h5"
    script.write_text(
        "from dataclasses import replace\n"
        "from own_task import TASK\n"
        "TASK = replace(TASK, name='sound', observations={'distances': (2,), 'loud': (1,)},\n"
        "               modalities={'near': ('distances',), 'level': ('loud',)})\n"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLE.parent))
        task = load_task(f"{script}:TASK")
        with open_dataset(folder / "own.h5") as episodes:
            some = [episodes[i] for i in (0, 1, 8, 9)]
        keys = task.observations
        write_dataset(
            data,
            task,
            (replace(e, task=task, observations={k: e.observations[k] for k in keys}) for e in some),
        )
        options = ("--data", f"sound={data}", "--filter", "lstm", "--seeds", 1, "--preset", "smoke")
        document = result("study", "--task", f"{script}:TASK", *options, "-o", tmp_path / "study")
    assert document["cells"] == {"sound/lstm/seed0": "finished"}
    assert [row["blackout"] for row in document["rows"]] == [0.0, 0.0, None]  # both starts, and the training mean
