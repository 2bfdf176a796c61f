"""Files of another version of Beliefscope: refused in one line that names both formats, and left as they are."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import h5py
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save
from starlette.testclient import TestClient

from beliefscope.app.jobs.queue import Job, Jobs
from beliefscope.app.runs.kept_filters import Child, keep
from beliefscope.app.runs.trace_store import Settings
from beliefscope.app.server.main import create_app
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


@pytest.fixture
def opened(tmp_path: Path) -> Callable[[], TestClient]:
    """Of servers on one workspace."""
    origin = "http://localhost:8000"
    return lambda: TestClient(
        create_app(Settings(tmp_path / "ws"), warm=False), base_url=origin, headers={"Origin": origin}
    )


LATER: dict[str, str] = {
    "kept.json": '{"format": 2, "children": [{"hash": "of a later version"}]}',
    "finetune/0123456789abcdef/run.json": '{"format": 2, "run": "0123456789abcdef"}',
    "my-study/study.json": '{"format": 2, "cells": []}',
    "reports/door-crossmodal-pf-episode9-01234567/manifest.json": '{"format": "beliefscope-report 2", "title": 2}',
    "reports/door-crossmodal-pf-episode9-01234567/report.html": "<!doctype html>",
    "recordings/a.rrd": "RRF9 of a later Rerun",
    "recordings/.about/a.rrd.json": '{"format": 2}',
    "live/a.live": "of a later version",
    "jobs/0123456789abcdef/job.json": '{"format": 2, "id": "0123456789abcdef"}',
}
"""What a later version might leave in a workspace, under names that this one looks at."""


def test_a_later_workspace_is_shown_as_far_as_it_can_be_and_kept(
    tmp_path: Path, opened: Callable[[], TestClient]
) -> None:
    for name, text in LATER.items():
        path = tmp_path / "ws" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    with opened() as client:
        said = {
            name: client.get(f"/api/{name}")
            for name in (
                "catalog",
                "jobs",
                "finetune/door/crossmodal-ekf",
                "lineage/door",
                "studies",
                "reports",
                "recordings",
                "live",
            )
        }
        assert {name: answer.status_code for name, answer in said.items()} == dict.fromkeys(said, 200)
        assert said["jobs"].json() == []
        assert said["finetune/door/crossmodal-ekf"].json()["runs"] == []
        (problem,) = said["studies"].json()["problems"]
        assert "my-study/study.json' does not hold a study's results" in problem
        assert [(one["name"], one["state"]) for one in said["live"].json()["runs"]] == [("a", "damaged")]
        assert [one["name"] for one in said["recordings"].json()["recordings"]] == ["a.rrd"]
        library = client.app.state.library  # type: ignore[attr-defined]
        child = Child("door", "mine", str(shipped("door", "image-ekf")), default=True)
        with pytest.raises(BadInput, match=r"kept\.json' is damaged or another version's: move it away"):
            keep(library, child)
    assert {name: (tmp_path / "ws" / name).read_text() for name in LATER} == LATER


def test_a_trace_of_another_version_is_made_anew(tmp_path: Path, opened: Callable[[], TestClient]) -> None:
    def header(client: TestClient) -> dict[str, Any]:
        while (answer := client.get("/api/trace/door/haptics-ekf/9")).status_code == 202:
            time.sleep(0.02)
        assert answer.status_code == 200, answer.text
        return dict(answer.json())

    with opened() as client:
        before = header(client)
    (path,) = (tmp_path / "ws" / "traces").iterdir()
    of_format(path, "beliefscope-trace", 2)
    with opened() as client:
        assert header(client) == before
    assert len(load_trace(path)) == before["steps"]


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
