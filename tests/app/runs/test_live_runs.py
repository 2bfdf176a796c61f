"""Ended live runs in a workspace: their names, and runs without steps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import pytest
from starlette.testclient import TestClient

from beliefscope.app.runs.settings import Settings
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.trace import Trace, trace
from beliefscope.inspect.traces.live_file import LiveFileWriter, write_live

pytestmark = pytest.mark.slow


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    (tmp_path / "workspace" / "live").mkdir(parents=True)
    return Settings(tmp_path / "workspace")


@pytest.fixture(scope="module")
def run_of_filter() -> Trace:
    with open_dataset(sample_path("door")) as data:
        return trace(load_checkpoint(pretrained_path("door", "crossmodal-ekf")), data[9], 9)


def test_a_filter_with_slashes_in_its_name(client: TestClient, settings: Settings, run_of_filter: Trace) -> None:
    own = replace(run_of_filter, filter="/odometry/filtered", checkpoint_hash="")
    write_live(own, settings.workspace / "live" / "run.live")
    (run,) = client.get("/api/live").json()["runs"]
    assert run["filter"] == "odometry-filtered"
    answer = client.get(f"/api/trace/door/{quote(run['filter'], safe='')}/9?data=live:run")
    assert answer.status_code == 200, answer.text
    assert answer.json()["filter"] == run["filter"]


@pytest.mark.parametrize("finished", [True, False])
def test_a_run_that_ended_before_its_first_step(
    client: TestClient, settings: Settings, run_of_filter: Trace, finished: bool
) -> None:
    writer = LiveFileWriter(settings.workspace / "live" / "run.live", run_of_filter)
    if finished:
        writer.finish()
    writer.close()
    answer = client.get(f"/api/trace/door/{run_of_filter.filter}/9?data=live:run")
    assert answer.status_code == 400
    assert "before its first step" in answer.text
