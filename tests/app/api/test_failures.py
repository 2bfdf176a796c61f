"""Failures of a filter over HTTP."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any
from urllib.parse import parse_qsl

import pytest
from starlette.testclient import TestClient

from beliefscope.app.jobs.failures import failure_document
from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.diagnostics.views import as_json
from beliefscope.inspect.failures.survey_json import MAX_EVENTS
from beliefscope.inspect.slices.report import find_slices
from beliefscope.inspect.traces.batch import trace_all

pytestmark = pytest.mark.slow

TIMEOUT = 90.0  # s, including the import of PyTorch by a job
URL = "/api/failures/door/crossmodal-ekf"
FAULTS = "blackout=0.5"


def wait_for_failures(client: TestClient, url: str = URL, **query: str) -> Any:
    """The result when the job is done."""
    end = time.monotonic() + TIMEOUT
    while (answer := client.get(url, params=query)).status_code == 202:
        assert answer.json()["job"]["state"] in ("waiting", "running"), answer.json()
        assert time.monotonic() < end
        time.sleep(0.05)
    assert answer.status_code == 200, answer.text
    return answer.json()


@pytest.fixture(scope="module")
def settings(base_settings: Settings, tmp_path_factory: pytest.TempPathFactory) -> Settings:
    """Of the server of ``client``."""
    return replace(base_settings, workspace=tmp_path_factory.mktemp("workspace"))


@pytest.fixture(scope="module")
def client(settings: Settings, open_client: Callable[..., TestClient]) -> Iterator[TestClient]:
    with open_client(settings) as client:
        yield client


def test_survey_is_a_job_and_stores_no_traces(
    client: TestClient, settings: Settings, open_client: Callable[..., TestClient], steps: int
) -> None:
    query = {"among": "all", "faults": FAULTS}
    assert client.get(URL, params=query).json() == {"job": None}
    response = client.post(URL, params=query)
    assert response.status_code == 202
    job = response.json()["job"]
    assert job["title"] == f"Failures of crossmodal-ekf, door, all 2 episodes, {FAULTS}"
    assert client.post(URL, params=query).json()["job"]["id"] == job["id"]
    result = wait_for_failures(client, **query)
    link = dict(parse_qsl(job["link"].removeprefix("?")))
    assert link == {"task": "door", "filter": "crossmodal-ekf", "data": "mine", "tab": "failures"} | query
    for other in ({"among": "held-out"}, {"faults": "blackout=0.6"}):  # other surveys
        assert client.get(URL, params=query | other).json() == {"job": None}
    assert not (settings.workspace / "traces").exists()

    store = TraceStore(settings)
    traces = trace_all(
        store.checkpoint("door", "crossmodal-ekf"),
        store.dataset("door", "")[1],
        [0, 1],
        faults=Faults.parse(FAULTS),
        particles=settings.particles,
    )
    selection = {"filter": "crossmodal-ekf", "data": "mine", "faults": FAULTS, "among": "all"}
    assert result == json.loads(json.dumps(failure_document(traces, selection)))
    store.close()
    few = "Slices were not searched: 2 episodes; a search for slices needs at least 8."
    assert result["scores"][0]["slices"] == {"summary": few, "rows": []}
    assert [(e["index"], e["steps"]) for e in result["episodes"]] == [(0, steps), (1, steps)]
    with open_client(settings) as second:  # on the same workspace
        assert second.get(URL, params=query).json() == result


def test_every_score_is_ranked_or_has_a_reason(client: TestClient) -> None:
    client.post(URL)
    result = wait_for_failures(client)
    assert [e["index"] for e in result["episodes"]] == [1]  # held out
    scores = {score["name"]: score for score in result["scores"]}
    assert list(scores) == ["error", "angle", "nees", "ess", "disagreement", "regret"]
    assert scores["ess"]["why_not"] == "this filter has no particles"
    assert "events" not in scores["ess"]
    for name, score in scores.items():
        if score["why_not"]:
            continue
        values = [event["value"] for event in score["events"]]
        assert values == sorted(values, reverse=True)
        assert min(values) > score["threshold"]
        assert sum(score["counts"].values()) == score["total"] == len(values) <= MAX_EVENTS
        assert sum(phase["events"] for phase in score["phases"]) == score["total"]
        for event in score["events"]:
            link = dict(parse_qsl(event["link"].removeprefix("?")))
            assert (link["episode"], link["step"]) == (str(event["episode"]), str(event["step"]))
            assert event["first"] <= event["step"] <= event["last"]
            if name == "error":
                assert event["value"] == event["error"][result["layers"].index("fused")]


@pytest.mark.long
def test_slices_are_those_of_the_command(client: TestClient) -> None:
    url = "/api/failures/push-field/information-ekf"
    client.post(url)
    result = wait_for_failures(client, url)
    (score,) = (score for score in result["scores"] if score["name"] == "error")
    with open_dataset(sample_path("push-field")) as data:
        report = find_slices(load_checkpoint(pretrained_path("push-field", "information-ekf")), data, data.held_out())
    assert report.slices
    assert score["slices"]["summary"] == report.summary
    rows = score["slices"]["rows"]
    assert [row["conditions"] for row in rows] == [as_json(slice_.conditions) for slice_ in report.slices]
    for row, slice_ in zip(rows, report.slices, strict=True):
        assert row["ratio"] == pytest.approx(slice_.ratio)
        assert (tuple(row["worst"]), row["steps"]) == (slice_.worst, slice_.steps)


@pytest.mark.parametrize(
    ("url", "query", "status", "message"),
    [
        ("/api/failures/door/none", {}, 400, "filter 'none'"),
        ("/api/failures/window/crossmodal-ekf", {}, 400, "task 'window'"),
        (URL, {"data": "none"}, 400, "data 'none'"),
        (URL, {"among": "some"}, 422, "held-out"),
        (URL, {"faults": "darkness"}, 400, "darkness"),
    ],
)
def test_invalid_requests_are_refused(
    client: TestClient, url: str, query: dict[str, str], status: int, message: str
) -> None:
    jobs = client.get("/api/jobs").json()
    for method in ("GET", "POST"):
        answer = client.request(method, url, params=query)
        assert answer.status_code == status
        assert message in answer.json()["error"]
    assert client.get("/api/jobs").json() == jobs


def test_results_with_earlier_keys_are_read(
    client: TestClient, settings: Settings, open_client: Callable[..., TestClient]
) -> None:
    client.post(URL, params={"faults": FAULTS})
    result = wait_for_failures(client, faults=FAULTS)
    assert result["scores"][0]["display_unit"] == "cm"
    job = client.post(URL, params={"faults": FAULTS}).json()["job"]["id"]
    (path,) = (p for p in (settings.workspace / "jobs" / job).rglob("*.json") if '"display_unit"' in p.read_text())
    path.write_text(path.read_text().replace('"display_unit"', '"shown"'))
    with open_client(settings) as later:
        assert later.get(URL, params={"faults": FAULTS}).json() == result
    assert '"shown"' not in path.read_text()
