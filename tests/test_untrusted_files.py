"""Files of others: what would run code, claim too much or be markup; and the page of threats is true."""

from __future__ import annotations

import ast
import json
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from safetensors import safe_open
from safetensors.torch import load_file, save

from beliefscope.app.runs.catalog import shelves
from beliefscope.datasets.catalog import TASKS, find_task
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.trace import load_trace, save_trace, trace
from beliefscope.recordings.read import read_recording

ROOT = Path(__file__).resolve().parents[1]

READERS: dict[str, Callable[[Path], Any]] = {
    "h5": open_dataset,
    "hdf5": open_dataset,
    "json": open_dataset,
    "safetensors": load_checkpoint,
    "trace": load_trace,
    "rrd": read_recording,
}


class Runs:
    """Makes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return open, (str(self.path), "w")


@pytest.mark.parametrize("suffix", READERS)
def test_a_file_that_would_run_code_runs_none(tmp_path: Path, suffix: str) -> None:
    ran, path = tmp_path / "ran", tmp_path / f"file.{suffix}"
    pickled = pickle.dumps(Runs(ran))
    with (tmp_path / "whole.npy").open("wb") as file:
        np.save(file, np.array([Runs(ran)], object), allow_pickle=True)
    for content in (pickled, (tmp_path / "whole.npy").read_bytes()):
        path.write_bytes(content)
        with pytest.raises(BadInput):
            READERS[suffix](path)
        assert not ran.exists()
    pickle.loads(pickled)
    assert ran.exists(), "or the file would have run nothing"


def test_an_hdf5_file_of_objects_is_no_data_set(tmp_path: Path) -> None:
    path = tmp_path / "door.h5"
    path.write_bytes(sample_path("door").read_bytes())
    with h5py.File(path, "r+") as file:
        group = next(one for one in file.values() if isinstance(one, h5py.Group))
        del group["states"]
        group.create_dataset("states", data=[pickle.dumps(Runs(tmp_path / "ran")).hex()], dtype=h5py.string_dtype())
    with pytest.raises(BadInput), open_dataset(path) as data:
        _ = [data[i] for i in range(len(data))]
    assert not (tmp_path / "ran").exists()


@pytest.fixture
def evil(tmp_path: Path) -> str:
    """The name of a task whose file says that it was run."""
    (tmp_path / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    return f"{tmp_path / 'evil.py'}:TASK"


def test_a_task_named_in_a_file_is_not_run(tmp_path: Path, evil: str) -> None:
    path = tmp_path / "filter.safetensors"
    with safe_open(shipped("door", "crossmodal-ekf"), "pt") as file:
        header = json.loads(file.metadata()["beliefscope"])
    header["architecture"]["task"] = evil
    tensors = load_file(shipped("door", "crossmodal-ekf"))
    path.write_bytes(save(tensors, metadata={"beliefscope": json.dumps(header)}))
    with pytest.raises(BadInput, match="does not exist"):
        load_checkpoint(path)

    data = tmp_path / "door.h5"
    data.write_bytes(sample_path("door").read_bytes())
    with h5py.File(data, "r+") as h5:
        h5.attrs["task"] = evil
    with pytest.raises(BadInput):
        open_dataset(data)

    with open_dataset(sample_path("door")) as episodes:
        made = trace(load_checkpoint(shipped("door", "crossmodal-ekf")), episodes[0], episode_index=0, seed=0)
    save_trace(made, tmp_path / "run.trace")
    with safe_open(tmp_path / "run.trace", "pt") as file:
        metadata = {key: value.replace('"door"', json.dumps(evil)) for key, value in file.metadata().items()}
    (tmp_path / "run.trace").write_bytes(save(load_file(tmp_path / "run.trace"), metadata=metadata))
    with pytest.raises(BadInput):
        find_task(load_trace(tmp_path / "run.trace").episode.task)

    found, problems = shelves({"evil": path}, {"evil": data})
    assert found.keys() == TASKS.keys()
    assert len(problems) == 2
    assert not (tmp_path / "ran").exists()


def test_a_file_that_claims_too_much_is_refused(tmp_path: Path) -> None:
    """A few kB that would be terabytes: refused by what they claim, before any of it is made."""
    path = tmp_path / "door.h5"
    path.write_bytes(sample_path("door").read_bytes())
    with h5py.File(path, "r+") as file:
        group = next(one for one in file.values() if isinstance(one, h5py.Group))
        shape = group["states"].shape
        del group["states"]
        group.create_dataset("states", (10**12, *shape[1:]), np.float32, chunks=(1024, *shape[1:]), compression="gzip")
    with pytest.raises(BadInput), open_dataset(path) as data:
        _ = [data[i] for i in range(len(data))]
    assert path.stat().st_size < 10**7

    for suffix in ("safetensors", "trace"):
        huge = json.dumps({"x": {"dtype": "F32", "shape": [10**12], "data_offsets": [0, 4 * 10**12]}}).encode()
        (tmp_path / f"file.{suffix}").write_bytes(len(huge).to_bytes(8, "little") + huge + bytes(100))
        with pytest.raises(BadInput):
            READERS[suffix](tmp_path / f"file.{suffix}")
        (tmp_path / f"file.{suffix}").write_bytes((2**62).to_bytes(8, "little") + bytes(100))
        with pytest.raises(BadInput):
            READERS[suffix](tmp_path / f"file.{suffix}")


SINKS = re.compile(r"\.(?:inner|outer)HTML\s*\+?=(?!=)\s*([^;]*)|insertAdjacentHTML|document\.write|srcdoc")


@pytest.mark.parametrize("path", sorted((ROOT / "app" / "page").rglob("*.js")), ids=lambda path: path.name)
def test_markup_is_written_by_constants_alone(path: Path) -> None:
    """Whatever becomes HTML is a text in the script itself, with nothing put into it."""
    text = path.read_text()
    for found in SINKS.finditer(text):
        value = found[1] or ""
        name = re.match(r"[A-Z_]+\b", value)
        if name:
            constant = re.search(rf"const {name[0]} =\s*(.*?);\n", text, re.DOTALL)
            assert constant, f"{found[0]}: {name[0]} is no constant"
            value = constant[1]
        assert value[:1] in ("'", "`"), found[0]
        assert "${" not in value, found[0]


def test_markup_with_something_put_into_it_would_be_found(tmp_path: Path) -> None:
    for line in ("row.innerHTML = `<b>${name}</b>`;", "row.innerHTML = name;", "row.insertAdjacentHTML('end', name);"):
        (tmp_path / "page.js").write_text(line)
        with pytest.raises(AssertionError):
            test_markup_is_written_by_constants_alone(tmp_path / "page.js")


def test_every_threat_has_tests_that_exist() -> None:
    known = set()
    for path in (ROOT / "tests").rglob("test_*.py"):
        known |= {node.name for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef)}
    rows = re.findall(r"^\| .* \|$", (ROOT / "docs" / "security.md").read_text().split("## Threats")[1], re.MULTILINE)[
        2:
    ]
    assert len(rows) >= 15
    for row in rows:
        tests = re.findall(r"`(test_\w+)`", row.split("|")[3])
        assert tests, row
        assert not set(tests) - known, row
