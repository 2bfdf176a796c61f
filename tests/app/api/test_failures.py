"""Where a filter fails, over HTTP: a survey is a job, its result what the library's own functions give."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any
from urllib.parse import parse_qsl

import pytest
from starlette.testclient import TestClient

from beliefscope.app.api.failures import LISTED, document
from beliefscope.app.runs.trace_store import Library
from beliefscope.app.server.main import Settings
from beliefscope.datasets.faults.injection import Faults
from beliefscope.inspect.failures.moments import survey_of

PATIENCE = 90.0  # s: a job imports PyTorch first
URL = "/api/failures/door/crossmodal-ekf"
FAULTS = "blackout=0.5"


def surveyed(client: TestClient, **query: str) -> Any:
    """The result, once the job is done."""
    end = time.monotonic() + PATIENCE
    while (answer := client.get(URL, params=query)).status_code == 202:
        assert answer.json()["job"]["state"] in ("waiting", "running"), answer.json()
        assert time.monotonic() < end
        time.sleep(0.05)
    assert answer.status_code == 200, answer.text
    return answer.json()


def test_a_survey_is_a_job_and_keeps_no_trace(
    settings: Settings, open_client: Callable[..., TestClient], steps: int
) -> None:
    query = {"among": "all", "faults": FAULTS}
    with open_client(settings) as client:
        assert client.get(URL, params=query).json() == {"job": None}
        asked = client.post(URL, params=query)
        assert asked.status_code == 202
        job = asked.json()["job"]
        assert job["title"] == f"Failures of crossmodal-ekf, door all 2 episodes, {FAULTS}"
        assert client.post(URL, params=query).json()["job"]["id"] == job["id"]
        found = surveyed(client, **query)
        opened = dict(parse_qsl(job["link"].removeprefix("?")))
        assert opened == {"task": "door", "filter": "crossmodal-ekf", "data": "mine", "tab": "failures"} | query
        assert client.get(URL).json() == {"job": None}  # of those held out, with nothing broken: another survey
    assert not (settings.workspace / "traces").exists()

    library = Library(settings)
    survey = survey_of(
        library.checkpoint("door", "crossmodal-ekf"),
        library.dataset("door", "")[1],
        [0, 1],
        faults=Faults.parse(FAULTS),
        particles=settings.particles,
    )
    library.close()
    wanted = {"filter": "crossmodal-ekf", "data": "mine", "faults": FAULTS, "among": "all"}
    assert found == json.loads(json.dumps(wanted | document(survey, "crossmodal-ekf", "mine")))
    assert [(one["index"], one["steps"]) for one in found["episodes"]] == [(0, steps), (1, steps)]
    with open_client(settings) as client:  # another server on the same workspace
        assert client.get(URL, params=query).json() == found


def test_it_ranks_by_every_score_or_says_why_not(client: TestClient) -> None:
    client.post(URL)
    found = surveyed(client)
    assert [one["index"] for one in found["episodes"]] == [1]  # the one held out
    scores = {score["name"]: score for score in found["scores"]}
    assert list(scores) == ["error", "angle", "nees", "ess", "disagreement", "regret"]
    assert scores["ess"]["why_not"] == "this filter has no particles"
    assert "moments" not in scores["ess"]
    for name, score in scores.items():
        if score["why_not"]:
            continue
        values = [moment["value"] for moment in score["moments"]]
        assert values == sorted(values, reverse=True)
        assert min(values) > score["threshold"]
        assert sum(score["counts"].values()) == score["total"] == len(values) <= LISTED
        assert sum(group["moments"] for group in score["groups"]) == score["total"]
        for moment in score["moments"]:
            opens = dict(parse_qsl(moment["link"].removeprefix("?")))
            assert (opens["episode"], opens["step"]) == (str(moment["episode"]), str(moment["step"]))
            assert moment["first"] <= moment["step"] <= moment["last"]
            if name == "error":
                assert moment["value"] == moment["error"][found["layers"].index("fused")]


@pytest.mark.parametrize(
    ("url", "query", "status", "said"),
    [
        ("/api/failures/door/none", {}, 400, "filter 'none'"),
        ("/api/failures/window/crossmodal-ekf", {}, 400, "task 'window'"),
        (URL, {"data": "none"}, 400, "data 'none'"),
        (URL, {"among": "some"}, 422, "held-out"),
        (URL, {"faults": "darkness"}, 400, "darkness"),
    ],
)
def test_what_cannot_be_looked_through_says_why(
    client: TestClient, url: str, query: dict[str, str], status: int, said: str
) -> None:
    for method in ("GET", "POST"):
        answer = client.request(method, url, params=query)
        assert answer.status_code == status
        assert said in answer.json()["error"]
    assert client.get("/api/jobs").json() == []
