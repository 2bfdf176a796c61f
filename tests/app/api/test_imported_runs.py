"""Runs of imported logs in a workspace: their list, and diagnostics of all runs of a filter."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from httpx import Response
from starlette.testclient import TestClient

from beliefscope.app.runs.settings import Settings
from beliefscope.app.workspace.healthy_records import record_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path

pytestmark = pytest.mark.slow

Run = Callable[..., tuple[int, str, str]]

MAP = """
task = "ferry"
dt = 0.1
[state]
x = "x"
yaw = {column = "yaw", unit = "rad"}
[sensors]
gps = "gps"
[estimate]
filter = "node"
mean = ["mean", "yaw"]
std = ["std", "std"]
"""


@pytest.fixture
def imported(run: Run, tmp_path: Path) -> Settings:
    """A workspace with six runs; in one of them, the heading spans more than half a turn."""
    rng = np.random.default_rng(0)
    logs = tmp_path / "logs"
    logs.mkdir()
    for i in range(6):
        x = np.cumsum(rng.normal(0.0, 0.1, 60))
        yaw = np.linspace(0.0, 5.0 if i == 2 else 0.5, 60)
        np.savez(logs / f"day_{i}.npz", x=x, yaw=yaw, gps=x, mean=x + rng.normal(0.0, 0.1, 60), std=np.full(60, 0.1))
    (tmp_path / "map.toml").write_text(MAP)
    live = tmp_path / "workspace" / "live"
    for path in sorted(logs.iterdir()):
        assert run("import", path, "--map", tmp_path / "map.toml", "-o", live)[0] == 0
    assert {path.name for path in live.iterdir()} == {f"day_{i}.live" for i in range(6)}
    return Settings(tmp_path / "workspace")


def finished(client: TestClient, url: str, query: dict[str, str]) -> Response:
    """The result of a job that has started."""
    end = time.monotonic() + 90.0
    while (answer := client.get(url, params=query)).status_code == 202 and time.monotonic() < end:
        time.sleep(0.05)
    assert answer.status_code == 200, answer.text
    return answer


@pytest.mark.long
def test_diagnostics_of_all_runs_of_a_filter(imported: Settings, open_client: Callable[..., TestClient]) -> None:
    with open_client(imported) as client:
        listed = client.get("/api/live").json()["runs"]
        assert {run["state"] for run in listed} == {"ended"}, listed
        query = {"data": "live:day_1", "episodes": "held-out"}
        url = "/api/diagnostics/consistency/ferry/node/0"
        assert client.get(url, params=query).json() == {"job": None}
        assert client.post(url, params=query).json()["job"]["title"].endswith("all 6 runs")
        answer = finished(client, url, query)
    assert answer.json()["trajectories"] == 6
    (table, *_) = answer.json()["tables"]
    assert max(row[table["columns"].index("episodes")] for row in table["rows"]) == 6


@pytest.fixture
def with_wrong(run: Run, imported: Settings) -> Settings:
    """The workspace with twelve further runs, whose estimates are wrong, and a folder of twelve healthy traces."""
    folder = imported.workspace.parent
    live = imported.workspace / "live"
    rng = np.random.default_rng(1)
    for name, count, size in (("healthy", 12, 0.1), ("wrong", 12, 0.5)):
        (folder / name).mkdir()
        for i in range(count):
            x, yaw = np.cumsum(rng.normal(0.0, 0.1, 60)), np.linspace(0.0, 0.5, 60)
            values = {"x": x, "yaw": yaw, "gps": x, "mean": x + rng.normal(0.0, size, 60), "std": np.full(60, 0.1)}
            np.savez(folder / name / f"{name}_{i}.npz", **values)
        logs = sorted((folder / name).iterdir())
        output = live if name == "wrong" else folder / "traces"
        assert run("import", *logs, "--map", folder / "map.toml", "-o", output)[0] == 0
    return imported


@pytest.mark.long
def test_runs_are_diagnosed_with_a_kept_record(
    run: Run, with_wrong: Settings, open_client: Callable[..., TestClient]
) -> None:
    folder, live = with_wrong.workspace.parent, with_wrong.workspace / "live"
    with open_client(with_wrong) as client:
        url, query = "ferry/node/0", {"data": "live:wrong_0"}
        assert "no healthy record" in client.get(f"/api/diagnosis/{url}", params=query).text
        all_runs, over = f"/api/diagnostics/consistency/{url}", {"data": "live:day_1", "episodes": "held-out"}
        client.post(all_runs, params=over)
        assert "No healthy record" in finished(client, all_runs, over).json()["verdict"]
        command = ("diagnose", live / "wrong_0.live", "--profile-from", folder / "traces")
        assert run(*command, "--workspace", with_wrong.workspace)[0] == 0
        answer = client.get(f"/api/diagnosis/{url}", params=query).json()["preliminary"]
        assert answer["headline"].startswith("Filter changed, while its readings show no fault")
        assert answer["healthy_episodes"] == 12
        assert client.get(all_runs, params=over).json() == {"job": None}  # not the result without the record
        other = client.get(f"/api/diagnosis/{url}", params={"data": "live:day_1"}).json()["preliminary"]
        assert other["state"] == "healthy"
        code, out, _ = run("diagnose", live / "wrong_0.live", "--workspace", with_wrong.workspace)
        assert (code, out.startswith("Filter changed, while its readings show no fault")) == (0, True)


@pytest.mark.long
def test_all_runs_of_a_filter_are_diagnosed_together(
    run: Run, with_wrong: Settings, open_client: Callable[..., TestClient]
) -> None:
    """As by the command line, and with the names of the runs."""
    folder, live = with_wrong.workspace.parent, with_wrong.workspace / "live"
    record = ("--profile-from", folder / "traces", "--workspace", with_wrong.workspace)
    code, out, error = run("diagnose", live, *record, "--json", "-")
    assert code == 0, error
    expected = json.loads(out)
    with open_client(with_wrong) as client:
        url, query = "/api/diagnosis/ferry/node/0", {"data": "live:day_1", "over": "held-out"}
        first = client.get(url, params=query)
        assert (first.status_code, first.json()["job"]) == (202, None)
        assert first.json()["preliminary"]["episodes"] == 1
        job = client.post(url, params=query).json()["job"]
        assert job["title"] == "Diagnosis of node, ferry, all 18 runs"
        result = finished(client, url, query).json()
    names = sorted([*(f"day_{i}" for i in range(6)), *(f"wrong_{i}" for i in range(12))])
    assert result["runs"] == {str(i): f"live:{name}" for i, name in enumerate(names)}
    assert (result["headline"], result["episodes"]) == (expected["headline"], 18)
    assert [cause["episodes"] for cause in result["causes"]] == [cause["episodes"] for cause in expected["causes"]]
    assert {"6", "17"} <= {str(index) for index in result["causes"][0]["episodes"]}


def test_an_invalid_record_of_the_workspace_is_named(run: Run, tmp_path: Path) -> None:
    path = record_path(tmp_path, load_checkpoint(pretrained_path("door", "crossmodal-ekf")))
    path.parent.mkdir()
    path.write_text("[]")
    code, _, error = run("diagnose", "door", "--filter", "crossmodal-ekf", "--workspace", tmp_path)
    assert (code, f"{path} is not a healthy record: " in " ".join(error.split())) == (2, True)
