"""The examples run and say what they promise. A task from plain arrays goes the whole way with no other change."""

from __future__ import annotations

import contextlib
import io
import json
import re
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from beliefscope.app.cli.main import main
from beliefscope.app.runs.trace_store import Library, Selection, Settings
from beliefscope.datasets import catalog
from beliefscope.datasets.catalog import TASKS, load_task
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.trace import load_trace, trace
from beliefscope.inspect.traces.live_file import load_live

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "own_task.py"
SPEC = f"{EXAMPLE}:TASK"


@contextlib.contextmanager
def fresh() -> Iterator[None]:
    """As in a new process: tasks that are found meanwhile are forgotten afterwards."""
    known = dict(TASKS)
    yield
    TASKS.clear()
    TASKS.update(known)
    catalog._FOREIGN.clear()


def run(*arguments: object) -> tuple[int, str, str]:
    """A command line, as in a process of its own: exit code, standard output, standard error."""
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, fresh():
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
    """Data, a filter, a trace and a recording, each made as a user would."""
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
    """What one of the numbered examples prints."""
    path = EXAMPLE.parent / name
    assert len(path.read_text().splitlines()) < 40
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(path), str(argument)])
        runpy.run_path(str(path), run_name="__main__")
    return capsys.readouterr().out


def test_diagnose(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = example("01_diagnose.py", tmp_path, capsys)
    assert all(f"{entry.title}. {entry.question}\n  " in said for entry in DIAGNOSTICS.values())
    assert "an oracle would" in said
    assert "95 % -" in said, "five trajectories give intervals"
    assert {path.stem for path in tmp_path.glob("*.pdf")} == {"weights", "consistency", "particles"}


def test_counterfactual(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = example("02_counterfactual.py", tmp_path / "what.svg", capsys)
    black, trusted, _ = re.findall(r"the error went from ([\d.]+) to ([\d.]+) cm", said)
    assert black[0] == trusted[0], "each is compared with the same run"
    assert float(black[1]) < float(trusted[1]), "trusting a black picture is worse than not"
    assert (tmp_path / "what.svg").read_text().startswith("<?xml")


def test_live(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    said = example("05_live.py", tmp_path, capsys)
    assert said == f"{tmp_path}/live/example.live: 100 steps, the hinge is at (81.0, -19.8) cm\n"
    checkpoint = load_checkpoint(shipped("door", "crossmodal-ekf"))
    with open_dataset(sample_path("door")) as data:
        whole = trace(checkpoint, data[9])
    found = load_live(tmp_path / "live" / "example.live")
    # Each picture on its own adds up in another order than all at once.
    np.testing.assert_allclose(found.estimate_mean, whole.estimate_mean, atol=1e-5)


def test_example_is_short() -> None:
    assert len(EXAMPLE.read_text().splitlines()) < 60


def test_whole_way(folder: Path) -> None:
    measured = result("evaluate", SPEC, "--filter", folder / "own.safetensors", "--data", folder / "own.h5")
    assert set(measured["rmse"]) == {"x_cm", "y_cm", "position_cm"}
    with fresh():
        load_task(SPEC)
        with open_dataset(folder / "own.h5") as data:
            assert measured["data_hash"] == data.hash
            traced = load_trace(folder / "own.trace")
            assert traced.data_hash == data[data.held_out()[0]].digest()
    assert traced.modalities == ("image", "sound")
    assert (folder / "own.rrd").stat().st_size > 10_000


def test_page_shows_it(folder: Path, tmp_path: Path) -> None:
    with fresh():
        load_task(SPEC)
        library = Library(Settings(tmp_path, {"own": folder / "own.h5"}, {"own": folder / "own.safetensors"}))
        try:
            catalog = library.catalog()
            assert catalog["problems"] == []
            shown = catalog["tasks"][0]
            assert (shown["name"], len(shown["data"][0]["episodes"])) == ("ball", 100)
            assert [one["name"] for one in shown["filters"]] == ["own"]
            assert library.default() == Selection("ball", "own", 9, data="own")
            traced = library.traced(library.default())
            assert traced.trace.modalities == ("image", "sound")
            assert len(traced.columns[1]) > 0
            assert traced.map(3, None, 41).layers == ("image", "sound", "fused")
        finally:
            library.close()


def test_its_filter_says_whose_it_is(folder: Path) -> None:
    code, _, err = run("evaluate", "door", "--filter", folder / "own.safetensors")
    assert code == 2
    assert "task 'ball' does not exist. Available: door, " in err
    assert "One of your own is named by its file: path/to/file.py:NAME." in err
    _, _, err = run("evaluate", SPEC, "--filter", folder / "own.safetensors")
    assert "Task 'ball' ships no sample set. Give its data with --data." in err


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
        ("", "own.py:TASK", r"own\.py holds no task 'TASK'\. Tasks in it: none\."),
        (TASK_FILE, "own.py:NUMBER", r"own\.py holds no task 'NUMBER'\. Tasks in it: TASK\."),
        ("1 / 0", "own.py:TASK", r"own\.py cannot be run: ZeroDivisionError: division by zero"),
        ("def", "own.py:TASK", r"own\.py cannot be run: SyntaxError"),
        ("", "no.such.module:TASK", r"module 'no\.such\.module' cannot be imported: ModuleNotFoundError: No module"),
        ("", "json:TASK", r"json holds no task 'TASK'"),
        (TASK_FILE, "own.py:TASK|door", r"own\.py:TASK is named 'door', which is taken"),
        (TASK_FILE, "own.py:TASK|a b", r"own\.py:TASK is named 'a b', expected a name without spaces"),
        (TASK_FILE, "own.py:TASK||('touch',)", r"modality 'haptics' has 'touch', which is not among its observations"),
        (
            TASK_FILE,
            "own.py:TASK||('felt', 'image')",
            r"modality 'haptics' has felt, image, expected one picture or only",
        ),
        (TASK_FILE, "own.py:TASK||('felt',)|z", r"component of task 'mine' 'z' does not exist\. Available: x, y"),
    ],
)
def test_files_that_are_no_tasks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str, spec: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    spec, name, keys, y, *_ = [*spec.split("|"), "", "", ""]
    (tmp_path / "own.py").write_text(content.format(name=name or "mine", keys=keys or "('felt',)", y=y or "y"))
    before = dict(TASKS)
    with pytest.raises(BadInput, match=message):
        load_task(spec)
    assert before == TASKS
