"""Untrusted files: code execution, excessive size claims, markup; and tests of the documented threats."""

from __future__ import annotations

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

from beliefscope.app.runs.catalog import task_catalogs
from beliefscope.datasets.catalog import TASKS
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.trace import load_trace, save_trace, trace
from beliefscope.recordings.read import read_recording

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]

READERS: dict[str, Callable[[Path], Any]] = {
    "h5": open_dataset,
    "hdf5": open_dataset,
    "json": open_dataset,
    "safetensors": load_checkpoint,
    "trace": load_trace,
    "rrd": read_recording,
}


class Payload:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return open, (str(self.path), "w")


@pytest.mark.parametrize("suffix", READERS)
def test_pickled_code_is_not_run(tmp_path: Path, suffix: str) -> None:
    ran, path = tmp_path / "ran", tmp_path / f"file.{suffix}"
    pickled = pickle.dumps(Payload(ran))
    with (tmp_path / "array.npy").open("wb") as file:
        np.save(file, np.array([Payload(ran)], object), allow_pickle=True)
    for content in (pickled, (tmp_path / "array.npy").read_bytes()):
        path.write_bytes(content)
        with pytest.raises(BadInput):
            READERS[suffix](path)
        assert not ran.exists()
    pickle.loads(pickled)
    assert ran.exists(), "the payload works"


def test_hdf5_files_with_objects_are_rejected(tmp_path: Path) -> None:
    path = tmp_path / "door.h5"
    path.write_bytes(sample_path("door").read_bytes())
    with h5py.File(path, "r+") as file:
        group = next(group for group in file.values() if isinstance(group, h5py.Group))
        del group["states"]
        group.create_dataset("states", data=[pickle.dumps(Payload(tmp_path / "ran")).hex()], dtype=h5py.string_dtype())
    with pytest.raises(BadInput), open_dataset(path) as data:
        _ = [data[i] for i in range(len(data))]
    assert not (tmp_path / "ran").exists()


@pytest.fixture
def malicious_task(tmp_path: Path) -> str:
    """Name of a task whose file leaves a trace when it is run."""
    (tmp_path / "malicious.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    return f"{tmp_path / 'evil.py'}:TASK"


def test_tasks_named_in_files_are_not_run(tmp_path: Path, malicious_task: str) -> None:
    path = tmp_path / "filter.safetensors"
    with safe_open(pretrained_path("door", "crossmodal-ekf"), "pt") as file:
        header = json.loads(file.metadata()["beliefscope"])
    header["architecture"]["task"] = malicious_task
    tensors = load_file(pretrained_path("door", "crossmodal-ekf"))
    path.write_bytes(save(tensors, metadata={"beliefscope": json.dumps(header)}))
    with pytest.raises(BadInput, match="does not exist"):
        load_checkpoint(path)

    data = tmp_path / "door.h5"
    data.write_bytes(sample_path("door").read_bytes())
    with h5py.File(data, "r+") as h5:
        h5.attrs["task"] = malicious_task
    with pytest.raises(BadInput):
        open_dataset(data)

    with open_dataset(sample_path("door")) as episodes:
        result = trace(load_checkpoint(pretrained_path("door", "crossmodal-ekf")), episodes[0], episode_index=0, seed=0)
    save_trace(result, tmp_path / "run.trace")
    with safe_open(tmp_path / "run.trace", "pt") as file:
        metadata = {key: value.replace('"door"', json.dumps(malicious_task)) for key, value in file.metadata().items()}
    (tmp_path / "run.trace").write_bytes(save(load_file(tmp_path / "run.trace"), metadata=metadata))
    with pytest.raises(BadInput):
        load_trace(tmp_path / "run.trace")

    catalogs, problems = task_catalogs({"filter": path}, {"data": data})
    assert catalogs.keys() == TASKS.keys()
    assert len(problems) == 2
    assert not (tmp_path / "ran").exists()


def test_excessive_size_claims_are_rejected(tmp_path: Path) -> None:
    """Files of a few kB that claim terabytes are rejected before memory is allocated."""
    path = tmp_path / "door.h5"
    path.write_bytes(sample_path("door").read_bytes())
    with h5py.File(path, "r+") as file:
        group = next(group for group in file.values() if isinstance(group, h5py.Group))
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
def test_markup_is_constant(path: Path) -> None:
    """HTML is assigned only from constant strings of the script."""
    text = path.read_text()
    for sink in SINKS.finditer(text):
        value = sink[1] or ""
        name = re.match(r"[A-Z_]+\b", value)
        if name:
            constant = re.search(rf"const {name[0]} =\s*(.*?);\n", text, re.DOTALL)
            assert constant, f"{sink[0]}: {name[0]} is not a constant"
            value = constant[1]
        assert value[:1] in ("'", "`"), sink[0]
        assert "${" not in value, sink[0]


def test_variable_markup_is_detected(tmp_path: Path) -> None:
    for line in ("row.innerHTML = `<b>${name}</b>`;", "row.innerHTML = name;", "row.insertAdjacentHTML('end', name);"):
        (tmp_path / "page.js").write_text(line)
        with pytest.raises(AssertionError):
            test_markup_is_constant(tmp_path / "page.js")


def test_documented_threats_have_tests() -> None:
    names = set()
    for path in (ROOT / "tests").rglob("test_*.py"):
        names |= {*re.findall(r"^def (test_\w+)", path.read_text(), re.MULTILINE)}
    rows = re.findall(r"^\| .* \|$", (ROOT / "docs" / "security.md").read_text().split("## Threats")[1], re.MULTILINE)[
        2:
    ]
    assert len(rows) >= 15
    for row in rows:
        tests = re.findall(r"`(test_\w+)`", row.split("|")[3])
        assert tests, row
        assert not set(tests) - names, row
