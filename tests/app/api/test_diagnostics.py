"""Diagnostics over HTTP, with pretrained filters and sample data."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import pytest
from starlette.testclient import TestClient

from beliefscope.app.runs.settings import Settings
from beliefscope.app.server.main import create_app
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnostics.base import Diagnostic, Entry
from beliefscope.inspect.diagnostics.views import VIEWS
from beliefscope.inspect.trace import trace

pytestmark = pytest.mark.slow

ORIGIN = "http://localhost:8000"
TIMEOUT = 90.0  # s, including the import of PyTorch by a job
EPISODE = 9


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    app = create_app(Settings(tmp_path_factory.mktemp("workspace"), particles=30), warm=False)
    with TestClient(app, base_url=ORIGIN, headers={"Origin": ORIGIN}) as client:
        yield client


def url(name: str, filter_: str = "crossmodal-ekf") -> str:
    return f"/api/diagnostics/{name}/door/{filter_}/{EPISODE}"


def poll(client: TestClient, address: str, **query: Any) -> Any:
    """The response once the trace and the job, if any, are finished."""
    end = time.monotonic() + TIMEOUT
    while (answer := client.get(address, params=query)).status_code == 202:
        state = answer.json()
        assert 0.0 <= state.get("progress", 0.0) <= 1.0
        if "job" in state and (state["job"] is None or state["job"]["state"] not in ("waiting", "running")):
            break
        assert time.monotonic() < end
        time.sleep(0.02)
    return answer


@dataclass(frozen=True)
class Length(Diagnostic):
    steps: int

    @property
    def verdict(self) -> str:
        return f"{self.steps} steps"


def test_list_of_diagnostics(server: TestClient) -> None:
    listed = server.get("/api/diagnostics").json()
    assert [entry["name"] for entry in listed] == list(DIAGNOSTICS)
    for entry in listed:
        assert entry["question"].endswith("?")
        assert entry["options"] == [
            {"name": o["name"], "meaning": DIAGNOSTICS[entry["name"]].options[o["name"]], "default": o["default"]}
            for o in entry["options"]
        ]
    assert {"name": "size", "meaning": "cells per side, 41 by default", "default": "41"} in next(
        entry for entry in listed if entry["name"] == "maps"
    )["options"]


def test_list_for_a_trace_gives_reasons(server: TestClient) -> None:
    reasons = {
        filter_: {
            entry["name"]: entry["why_not"]
            for entry in poll(server, f"/api/diagnostics/door/{filter_}/{EPISODE}").json()
        }
        for filter_ in ("crossmodal-ekf", "crossmodal-pf")
    }
    assert reasons["crossmodal-ekf"]["particles"] == "filter crossmodal-ekf has no particles"
    assert reasons["crossmodal-pf"]["particles"] is None
    assert reasons["crossmodal-ekf"]["consistency"] is None


def test_fast_diagnostic_equals_function_result(server: TestClient) -> None:
    answer = poll(server, url("consistency"))
    assert answer.status_code == 200, answer.text
    result = answer.json()
    checkpoint = load_checkpoint(pretrained_path("door", "crossmodal-ekf"))
    with open_dataset(sample_path("door")) as data:
        run = trace(checkpoint, data[EPISODE], EPISODE)
    expected = DIAGNOSTICS["consistency"]([run], checkpoint).views()
    assert result.pop("trajectories") == 1
    assert set(result) == {"verdict", *VIEWS}
    assert result == expected


def test_results_are_cached_by_trace_and_options(server: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[int, float]] = []

    def run(traces: Any, every: int = 1, share: float | None = None) -> Length:
        calls.append((every, share or 0.0))
        return Length(len(range(0, len(traces[0]), every)))

    entry = Entry("length", "Length", "How long is it?", run, options={"every": "steps", "share": "0 to 1"})
    monkeypatch.setitem(DIAGNOSTICS, "length", entry)
    first = poll(server, url("length"))
    assert first.json()["verdict"] == "100 steps"
    assert poll(server, url("length"), every="2", share="0.5").json()["verdict"] == "50 steps"
    assert poll(server, url("length"), every="").content == first.content
    assert poll(server, url("length"), faults="blackout=0.5").json()["verdict"] == "100 steps"
    assert calls == [(1, 0.0), (2, 0.5), (1, 0.0)]
    assert entry.to_json()["options"] == [
        {"name": "every", "meaning": "steps", "default": "1"},
        {"name": "share", "meaning": "0 to 1", "default": ""},
    ]


def test_errors_name_the_reason(server: TestClient) -> None:
    poll(server, url("consistency"))
    for method in ("GET", "POST"):
        inapplicable = server.request(method, url("particles"))
        assert (inapplicable.status_code, inapplicable.json()) == (
            409,
            {"error": "filter crossmodal-ekf has no particles"},
        )
        unknown = server.request(method, url("tea-leaves"))
        assert unknown.status_code == 404
        assert f"'tea-leaves' does not exist. Available: {', '.join(DIAGNOSTICS)}." in unknown.json()["error"]
        bad = server.request(method, url("maps"), params={"size": "large"})
        assert bad.status_code == 400
        assert bad.json()["error"] == (
            "option 'size' of maps (cells per side, 41 by default) is 'large': "
            "Input should be a valid integer, unable to parse string as an integer."
        )
        unknown_option = server.request(method, url("maps"), params={"colour": "red"})
        assert (unknown_option.status_code, "Available: size" in unknown_option.text) == (400, True)
        invalid = server.request(method, url("maps"), params={"episodes": "some"})
        assert (invalid.status_code, "held-out" in invalid.text) == (422, True)
    assert server.get("/api/diagnostics/consistency/door/nope/0").status_code == 400


def test_slow_diagnostic_is_a_job(server: TestClient) -> None:
    quick = {"size": "5"}
    assert poll(server, url("maps"), **quick).json() == {"job": None}
    response = server.post(url("maps"), params=quick)
    job = response.json()["job"]
    assert (response.status_code, job["state"]) == (202, "running")
    assert job["title"] == f"Likelihood maps of crossmodal-ekf, door episode {EPISODE}"
    query = {
        "task": "door",
        "filter": "crossmodal-ekf",
        "tab": "diagnostics",
        "diagnostic": "maps",
        "options": "size=5",
    }
    assert query.items() <= dict(parse_qsl(job["link"].removeprefix("?"))).items()
    assert server.post(url("maps"), params=quick).json()["job"]["id"] == job["id"]
    answer = poll(server, url("maps"), **quick)
    assert answer.status_code == 200, answer.text
    checkpoint = load_checkpoint(pretrained_path("door", "crossmodal-ekf"))
    with open_dataset(sample_path("door")) as data:
        run = trace(checkpoint, data[EPISODE], EPISODE)
    assert answer.json()["verdict"] == DIAGNOSTICS["maps"]([run], checkpoint, size=5).verdict
    assert server.get(f"/api/jobs/{job['id']}/result").json() == answer.json()
    assert server.get(f"/api/jobs/{job['id']}").json()["state"] == "done"
    assert poll(server, url("maps")).json() == {"job": None}  # other options are another result


@pytest.mark.long
def test_held_out_episodes(server: TestClient) -> None:
    poll(server, url("consistency"))
    assert server.get(url("consistency"), params={"episodes": "held-out"}).json() == {"job": None}
    job = server.post(url("consistency"), params={"episodes": "held-out"}).json()["job"]
    assert job["title"].endswith("door, all 64 held-out episodes")
    answer = poll(server, url("consistency"), episodes="held-out")
    assert answer.status_code == 200, answer.text
    assert answer.json()["trajectories"] == 64
    (table, *_) = answer.json()["tables"]
    trajectories = table["columns"].index("episodes")
    assert max(row[trajectories] for row in table["rows"]) == 64


def test_failed_job_reports_reason(server: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    # The job's process has the unmodified catalog and refuses.
    monkeypatch.setitem(DIAGNOSTICS, "particles", replace(DIAGNOSTICS["particles"], why_not=lambda *_: None, slow=True))
    poll(server, url("particles"))
    server.post(url("particles"))
    job = poll(server, url("particles")).json()["job"]
    assert (job["state"], job["error"]) == ("failed", "filter crossmodal-ekf has no particles")


def test_settings_json_round_trip(tmp_path: Path, root: Path) -> None:
    settings = Settings(
        tmp_path,
        data={"mine": tmp_path / "door.h5"},
        checkpoints={"own": tmp_path / "own.safetensors"},
        particles=7,
        seed=3,
        tasks=("push",),
    )
    assert Settings.from_json(settings.to_json()) == settings
    with pytest.raises(BadInput, match="task 'nope'"):
        Settings.from_json(settings.to_json() | {"tasks": ["nope"]})
    source = f"{root / 'examples' / '04_own_filter.py'}:build"
    external = Settings.from_json(settings.to_json() | {"checkpoints": {"own": {"source": source, "task": "door"}}})
    again = Settings.from_json(external.to_json())
    assert again.checkpoints["own"].hash == external.checkpoints["own"].hash  # type: ignore[union-attr]


@pytest.fixture
def root() -> Path:
    return Path(__file__).resolve().parents[3]
