"""Files of another version of Beliefscope: refused in one line that names both formats, and left as they are."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import h5py
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save

from beliefscope.app.jobs import Job, Jobs
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.trace import load_trace, save_trace, trace


def of_format(path: Path, entry: str, version: int) -> None:
    """Gives a safetensors file's header another format."""
    with safe_open(path, "np") as file:
        metadata = file.metadata()
    metadata[entry] = json.dumps(json.loads(metadata[entry]) | {"format": version})
    path.write_bytes(save(load_file(path), metadata=metadata))


def episodes(path: Path, version: int) -> None:
    path.write_bytes(sample_path("door").read_bytes())
    with h5py.File(path, "r+") as file:
        file.attrs["version"] = version


def checkpoint(path: Path, version: int) -> None:
    path.write_bytes(shipped("door", "image-ekf").read_bytes())
    of_format(path, "beliefscope", version)


def run(path: Path, version: int) -> None:
    if not path.exists():
        with open_dataset(sample_path("door")) as data:
            made = trace(load_checkpoint(shipped("door", "image-ekf")), data[0], episode_index=0, seed=0)
        save_trace(made, path)
    of_format(path, "beliefscope-trace", version)


FILES: dict[str, tuple[Callable[[Path, int], None], Callable[[Path], Any]]] = {
    "episodes.h5": (episodes, open_dataset),
    "filter.safetensors": (checkpoint, load_checkpoint),
    "run.trace": (run, load_trace),
}


@pytest.mark.parametrize("name", FILES)
def test_another_format_is_refused_by_both_numbers_and_kept(tmp_path: Path, name: str) -> None:
    write, read = FILES[name]
    path = tmp_path / name
    write(path, 1)
    read(path)
    for version in (0, 2):
        write(path, version)
        before = path.read_bytes()
        with pytest.raises(BadInput, match=rf"(version|format) {version}\b.*reads (version|format) 1"):
            read(path)
        assert path.read_bytes() == before
        assert [one.name for one in tmp_path.iterdir()] == [name]


def test_jobs_of_another_version_are_left_alone(tmp_path: Path) -> None:
    for id, more in (("0123456789abcdef", {}), ("fedcba9876543210", {"of_a_later_version": 1})):
        (tmp_path / id).mkdir()
        (tmp_path / id / "job.json").write_text(json.dumps(asdict(Job(id, "report", id, state="done")) | more))
    later = (tmp_path / "fedcba9876543210" / "job.json").read_bytes()
    jobs = Jobs(tmp_path)
    listed = {job.id for job in jobs.all()}
    jobs.close()
    assert "0123456789abcdef" in listed
    assert (tmp_path / "fedcba9876543210" / "job.json").read_bytes() == later
