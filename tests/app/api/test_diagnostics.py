"""Diagnostics over HTTP, with filters and episodes that ship."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import pytest
from starlette.testclient import TestClient

from beliefscope.app.api import diagnostics
from beliefscope.app.runs.trace_store import Settings
from beliefscope.app.server.main import create_app
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnostics.base import VIEWS, Diagnostic, Entry
from beliefscope.inspect.trace import trace

ORIGIN = "http://localhost:8000"
PATIENCE = 90.0  # s: a job imports PyTorch first
EPISODE = 9


@pytest.fixture
def shown(tmp_path: Path) -> Iterator[TestClient]:
    app = create_app(Settings(tmp_path / "workspace", particles=30), warm=False)
    with TestClient(app, base_url=ORIGIN, headers={"Origin": ORIGIN}) as client:
        yield client


def url(name: str, filter_: str = "crossmodal-ekf") -> str:
    return f"/api/diagnostics/{name}/door/{filter_}/{EPISODE}"


def answered(client: TestClient, address: str, **query: Any) -> Any:
    """The answer once the trace, and the job where there is one, is there."""
    end = time.monotonic() + PATIENCE
    while (answer := client.get(address, params=query)).status_code == 202:
        said = answer.json()
        assert 0.0 <= said.get("progress", 0.0) <= 1.0
        if "job" in said and (said["job"] is None or said["job"]["state"] not in ("waiting", "running")):
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


def test_the_list_says_what_each_answers(shown: TestClient) -> None:
    listed = shown.get("/api/diagnostics").json()
    assert [entry["name"] for entry in listed] == list(DIAGNOSTICS)
    for entry in listed:
        assert entry["question"].endswith("?")
        assert entry["options"] == [
            {"name": o["name"], "meaning": DIAGNOSTICS[entry["name"]].options[o["name"]], "default": o["default"]}
            for o in entry["options"]
        ]
    assert {"name": "size", "meaning": "cells along a side, 41 by default", "default": "41"} in next(
        entry for entry in listed if entry["name"] == "maps"
    )["options"]


def test_of_a_trace_the_list_says_what_does_not_apply(shown: TestClient) -> None:
    refused = {
        filter_: {
            entry["name"]: entry["why_not"]
            for entry in answered(shown, f"/api/diagnostics/door/{filter_}/{EPISODE}").json()
        }
        for filter_ in ("crossmodal-ekf", "crossmodal-pf")
    }
    assert refused["crossmodal-ekf"]["particles"] == "crossmodal-ekf has no particles"
    assert refused["crossmodal-pf"]["particles"] is None
    assert refused["crossmodal-ekf"]["consistency"] is None


def test_a_fast_one_is_what_the_function_gives(shown: TestClient) -> None:
    answer = answered(shown, url("consistency"))
    assert answer.status_code == 200, answer.text
    got = answer.json()
    checkpoint = load_checkpoint(shipped("door", "crossmodal-ekf"))
    with open_dataset(sample_path("door")) as data:
        made = trace(checkpoint, data[EPISODE], EPISODE)
    wanted = DIAGNOSTICS["consistency"]([made], checkpoint).views()
    assert got.pop("trajectories") == 1
    assert set(got) == {"verdict", *VIEWS}
    assert got == wanted


def test_it_is_computed_once_for_a_trace_and_its_options(shown: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, float]] = []

    def run(traces: Any, every: int = 1, share: float | None = None) -> Length:
        asked.append((every, share or 0.0))
        return Length(len(range(0, len(traces[0]), every)))

    entry = Entry("length", "Length", "How long is it?", run, options={"every": "steps", "share": "0 to 1"})
    monkeypatch.setitem(DIAGNOSTICS, "length", entry)
    first = answered(shown, url("length"))
    assert first.json()["verdict"] == "100 steps"
    assert answered(shown, url("length"), every="2", share="0.5").json()["verdict"] == "50 steps"
    assert answered(shown, url("length"), every="").content == first.content
    assert answered(shown, url("length"), faults="blackout=0.5").json()["verdict"] == "100 steps"
    assert asked == [(1, 0.0), (2, 0.5), (1, 0.0)]
    monkeypatch.setattr(diagnostics, "RESULTS_IN_MEMORY", 1)
    answered(shown, url("length"), every="4")
    answered(shown, url("length"))
    assert len(asked) == 5
    assert diagnostics.described(entry)["options"] == [
        {"name": "every", "meaning": "steps", "default": "1"},
        {"name": "share", "meaning": "0 to 1", "default": ""},
    ]


def test_what_cannot_be_had_says_why(shown: TestClient) -> None:
    answered(shown, url("consistency"))
    for method in ("GET", "POST"):
        refused = shown.request(method, url("particles"))
        assert (refused.status_code, refused.json()) == (409, {"error": "crossmodal-ekf has no particles"})
        unknown = shown.request(method, url("tea-leaves"))
        assert unknown.status_code == 404
        assert f"'tea-leaves' does not exist. Available: {', '.join(DIAGNOSTICS)}." in unknown.json()["error"]
        bad = shown.request(method, url("maps"), params={"size": "large"})
        assert bad.status_code == 400
        assert bad.json()["error"] == (
            "maps's 'size' is 'large': Input should be a valid integer, unable to parse string as an integer. "
            "It is cells along a side, 41 by default."
        )
        unheard = shown.request(method, url("maps"), params={"colour": "red"})
        assert (unheard.status_code, "Available: size" in unheard.text) == (400, True)
        some = shown.request(method, url("maps"), params={"episodes": "some"})
        assert (some.status_code, "held-out" in some.text) == (422, True)
    assert shown.get("/api/diagnostics/consistency/door/nope/0").status_code == 400


def test_a_slow_one_is_a_job_that_is_asked_for(shown: TestClient) -> None:
    quick = {"size": "5"}
    assert answered(shown, url("maps"), **quick).json() == {"job": None}
    asked = shown.post(url("maps"), params=quick)
    job = asked.json()["job"]
    assert (asked.status_code, job["state"]) == (202, "running")
    assert job["title"] == f"Likelihood maps of crossmodal-ekf, door episode {EPISODE}"
    opens = {
        "task": "door",
        "filter": "crossmodal-ekf",
        "tab": "diagnostics",
        "diagnostic": "maps",
        "options": "size=5",
    }
    assert opens.items() <= dict(parse_qsl(job["link"].removeprefix("?"))).items()
    assert shown.post(url("maps"), params=quick).json()["job"]["id"] == job["id"]
    answer = answered(shown, url("maps"), **quick)
    assert answer.status_code == 200, answer.text
    checkpoint = load_checkpoint(shipped("door", "crossmodal-ekf"))
    with open_dataset(sample_path("door")) as data:
        made = trace(checkpoint, data[EPISODE], EPISODE)
    assert answer.json()["verdict"] == DIAGNOSTICS["maps"]([made], checkpoint, size=5).verdict
    assert shown.get(f"/api/jobs/{job['id']}/result").json() == answer.json()
    assert shown.get(f"/api/jobs/{job['id']}").json()["state"] == "done"
    assert answered(shown, url("maps")).json() == {"job": None}  # with other options it is another one


@pytest.mark.long
def test_over_all_held_out_episodes_it_has_bounds(shown: TestClient) -> None:
    answered(shown, url("consistency"))
    assert shown.get(url("consistency"), params={"episodes": "held-out"}).json() == {"job": None}
    job = shown.post(url("consistency"), params={"episodes": "held-out"}).json()["job"]
    assert job["title"].endswith("door all 14 held-out episodes")
    answer = answered(shown, url("consistency"), episodes="held-out")
    assert answer.status_code == 200, answer.text
    assert answer.json()["trajectories"] == 14
    (table, *_) = answer.json()["tables"]
    trajectories = table["columns"].index("trajectories")
    assert max(row[trajectories] for row in table["rows"]) == 14


def test_a_failed_one_says_why(shown: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    # Refused only where it runs: the process has the catalog as it ships.
    monkeypatch.setitem(DIAGNOSTICS, "particles", replace(DIAGNOSTICS["particles"], why_not=lambda *_: None, slow=True))
    answered(shown, url("particles"))
    shown.post(url("particles"))
    job = answered(shown, url("particles")).json()["job"]
    assert (job["state"], job["error"]) == ("failed", "crossmodal-ekf has no particles")


def test_settings_travel_as_json(tmp_path: Path, root: Path) -> None:
    settings = Settings(
        tmp_path,
        data={"mine": tmp_path / "door.h5"},
        checkpoints={"own": tmp_path / "own.safetensors"},
        particles=7,
        seed=3,
        tasks=("push",),
    )
    assert Settings.of_json(settings.to_json()) == settings
    with pytest.raises(BadInput, match="task 'nope'"):
        Settings.of_json(settings.to_json() | {"tasks": ["nope"]})
    source = f"{root / 'examples' / '04_own_filter.py'}:build"
    foreign = diagnostics.Settings.of_json(
        settings.to_json() | {"checkpoints": {"own": {"source": source, "task": "door"}}}
    )
    again = Settings.of_json(foreign.to_json())
    assert again.checkpoints["own"].hash == foreign.checkpoints["own"].hash  # type: ignore[union-attr]


@pytest.fixture
def root() -> Path:
    return Path(__file__).resolve().parents[3]
