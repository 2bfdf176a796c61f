"""Files of other versions of Beliefscope: rejected with both version numbers, and never changed."""

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
from beliefscope.app.runs.settings import Settings
from beliefscope.app.server.main import create_app
from beliefscope.app.workspace.saved_filters import SavedFilter
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.trace import load_trace, save_trace, trace

pytestmark = pytest.mark.slow


def set_format(path: Path, entry: str, version: int) -> None:
    """Change the format version in the header of a safetensors file."""
    with safe_open(path, "np") as file:
        metadata = file.metadata()
    metadata[entry] = json.dumps(json.loads(metadata[entry]) | {"format": version})
    path.write_bytes(save(load_file(path), metadata=metadata))


def episodes(path: Path, version: int) -> None:
    path.write_bytes(sample_path("door").read_bytes())
    with h5py.File(path, "r+") as file:
        file.attrs["version"] = version


def checkpoint(path: Path, version: int) -> None:
    path.write_bytes(pretrained_path("door", "image-ekf").read_bytes())
    set_format(path, "beliefscope", version)


def run(path: Path, version: int) -> None:
    if not path.exists():
        with open_dataset(sample_path("door")) as data:
            result = trace(load_checkpoint(pretrained_path("door", "image-ekf")), data[0], episode_index=0, seed=0)
        save_trace(result, path)
    set_format(path, "beliefscope-trace", version)


FILES: dict[str, tuple[Callable[[Path, int], None], Callable[[Path], Any]]] = {
    "episodes.h5": (episodes, open_dataset),
    "filter.safetensors": (checkpoint, load_checkpoint),
    "run.trace": (run, load_trace),
}


@pytest.mark.parametrize("name", FILES)
def test_other_formats_are_rejected_with_both_version_numbers(tmp_path: Path, name: str) -> None:
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
        assert [file.name for file in tmp_path.iterdir()] == [name]


@pytest.fixture
def open_server(tmp_path: Path) -> Callable[[], TestClient]:
    """Opens servers on the same workspace."""
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
    "live/a.live": "of a later version",
    "jobs/0123456789abcdef/job.json": '{"format": 2, "id": "0123456789abcdef"}',
}
"""Files of a later version, under names that this version reads."""

METADATA = "recordings/.about/a.rrd.json"
"""Derived from the recording, and written again by the version that reads it."""


def test_a_workspace_of_a_later_version_is_readable_and_kept(
    tmp_path: Path, open_server: Callable[[], TestClient]
) -> None:
    for name, text in (LATER | {METADATA: '{"format": 2}'}).items():
        path = tmp_path / "ws" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    with open_server() as client:
        responses = {
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
        assert {name: answer.status_code for name, answer in responses.items()} == dict.fromkeys(responses, 200)
        assert responses["jobs"].json() == []
        assert responses["finetune/door/crossmodal-ekf"].json()["runs"] == []
        (problem,) = responses["studies"].json()["problems"]
        assert "my-study/study.json' does not contain the results of a study" in problem
        assert [(run["name"], run["state"]) for run in responses["live"].json()["runs"]] == [("a", "damaged")]
        assert [file["name"] for file in responses["recordings"].json()["recordings"]] == ["a.rrd"]
        store = client.app.state.store  # type: ignore[attr-defined]
        new = SavedFilter("door", "mine", str(pretrained_path("door", "image-ekf")), default=True)
        with pytest.raises(BadInput, match=r"kept\.json' is damaged or was written by another version: move it away"):
            store.saved.save(new)
    assert {name: (tmp_path / "ws" / name).read_text() for name in LATER} == LATER


def test_traces_of_other_versions_are_computed_again(tmp_path: Path, open_server: Callable[[], TestClient]) -> None:
    def header(client: TestClient) -> dict[str, Any]:
        while (answer := client.get("/api/trace/door/haptics-ekf/9")).status_code == 202:
            time.sleep(0.02)
        assert answer.status_code == 200, answer.text
        return dict(answer.json())

    with open_server() as client:
        before = header(client)
    (path,) = (tmp_path / "ws" / "traces").iterdir()
    set_format(path, "beliefscope-trace", 2)
    with open_server() as client:
        assert header(client) == before
    assert len(load_trace(path)) == before["steps"]


def test_jobs_of_other_versions_are_kept(tmp_path: Path) -> None:
    for id, more in (("0123456789abcdef", {}), ("fedcba9876543210", {"later_field": 1})):
        (tmp_path / id).mkdir()
        (tmp_path / id / "job.json").write_text(json.dumps(asdict(Job(id, "report", id, state="done")) | more))
    later = (tmp_path / "fedcba9876543210" / "job.json").read_bytes()
    jobs = Jobs(tmp_path)
    listed = {job.id for job in jobs.all()}
    jobs.close()
    assert "0123456789abcdef" in listed
    assert (tmp_path / "fedcba9876543210" / "job.json").read_bytes() == later
