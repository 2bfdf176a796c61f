"""Diagnosis of a filter over HTTP."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import pytest
from starlette.testclient import TestClient
from tests.inspect.diagnosis.checks.test_innovations import sail, task

from beliefscope.app.api.diagnosis import _repair_arguments
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.external.load import load_external
from beliefscope.inspect.diagnosis.diagnose import diagnose, required_profile
from beliefscope.inspect.diagnosis.undo.repair import healthy_bound, smallest_repair
from beliefscope.inspect.diagnostics.views import as_json

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[3]

TIMEOUT = 90.0  # s, including the import of PyTorch by a job
URL = "/api/diagnosis/door/crossmodal-ekf/9"
FAULTS = "image_frozen=5"


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> Settings:
    """Of a server with the pretrained filters, which have healthy records."""
    return Settings(workspace=tmp_path_factory.mktemp("workspace"))


@pytest.fixture(scope="module")
def server(settings: Settings, open_client: Callable[..., TestClient]) -> Iterator[TestClient]:
    with open_client(settings) as client:
        yield client


def test_diagnosis_is_a_job_and_equals_that_of_the_command(server: TestClient, settings: Settings) -> None:
    query = {"faults": FAULTS, "over": "episode"}
    first = wait_for_trace(server, query)
    assert first["job"] is None
    assert first["preliminary"]["causes"][0]["cause"] == "image.frozen"
    assert all(cause["recovered"] is None for cause in first["preliminary"]["causes"])
    response = server.post(URL, params=query)
    assert response.status_code == 202
    job = response.json()["job"]
    assert job["title"] == f"Diagnosis of crossmodal-ekf, door episode 9, {FAULTS}"
    link = dict(parse_qsl(job["link"].removeprefix("?")))
    run = {"task": "door", "filter": "crossmodal-ekf", "data": "sample", "episode": "9", "tab": "diagnosis"}
    assert link == run | query
    end = time.monotonic() + TIMEOUT
    while (answer := server.get(URL, params=query)).status_code == 202:
        assert answer.json()["job"]["state"] in ("waiting", "running"), answer.text
        assert time.monotonic() < end
        time.sleep(0.05)
    result = answer.json()
    store = TraceStore(settings)
    episode = Faults.parse(FAULTS).apply(store.dataset("door", "")[1][9], settings.seed)
    expected = diagnose(
        store.checkpoint("door", "crossmodal-ekf"), {9: episode}, seed=settings.seed, particles=settings.particles
    )
    store.close()
    assert result["causes"][0]["cause"] == "image.frozen"
    assert result == json.loads(json.dumps(as_json(expected.to_json())))


def test_a_healthy_run_needs_no_job(server: TestClient, settings: Settings) -> None:
    result = wait_for_trace(server, {})
    assert result["state"] == "healthy"
    both = wait_for_trace(server, {"over": "held-out"})
    assert both == {"job": None, "preliminary": result}
    store = TraceStore(settings)
    episodes = {9: store.dataset("door", "")[1][9]}
    expected = diagnose(store.checkpoint("door", "crossmodal-ekf"), episodes, particles=settings.particles)
    store.close()
    assert result == as_json(expected.to_json())


def wait_for_trace(client: TestClient, query: dict[str, str]) -> Any:
    """Reply to the request for a diagnosis when the trace has been computed."""
    while "progress" in (reply := client.get(URL, params=query).json()):
        time.sleep(0.05)
    return reply


@pytest.mark.long
def test_the_smallest_repair_is_that_of_the_command(server: TestClient, settings: Settings) -> None:
    url, faults = "/api/repair/push/crossmodal-ekf/9", "image_occluded=14:from=40:to=60"
    assert server.get(url, params={"faults": faults}).json() == {"job": None}
    job = server.post(url, params={"faults": faults}).json()["job"]
    assert job["title"] == f"Smallest repair of crossmodal-ekf, push episode 9, {faults}"
    end = time.monotonic() + TIMEOUT
    while (answer := server.get(url, params={"faults": faults})).status_code == 202:
        assert time.monotonic() < end
        time.sleep(0.05)
    result = answer.json()
    store = TraceStore(settings)
    run = store.request(Selection("push", "crossmodal-ekf", 9, Faults.parse(faults)))
    bound = healthy_bound(required_profile(run.checkpoint).statistics)
    expected = smallest_repair(run.checkpoint, run.trace, bound, store.dataset("push", "")[1][9])
    store.close()
    assert expected is not None
    assert expected.candidate is not None
    assert result == as_json({"sentence": expected.sentence, **expected.to_json()})


BOATS = f"""
import sys
sys.path.insert(0, {str(ROOT)!r})
import beliefscope as bs
from tests.inspect.diagnosis.checks.test_innovations import BIAS, FLIPPED, STD, Boat, sail, task

TASK = task(4)

def adapter(boat):
    return bs.Adapter(boat, batched=False, modalities=tuple(STD), initial_std=(0.5, 0.5, 0.1, BIAS), task=TASK)

def right():
    return adapter(Boat())

def wrong():
    return adapter(Boat(jacobian=FLIPPED))

class Failing(Boat):
    def initialize_beliefs(self, **belief):
        super().initialize_beliefs(**belief)
        self.steps = 0

    def __call__(self, **inputs):
        self.steps += 1
        if self.steps > 15:
            raise ArithmeticError("not positive definite")
        return super().__call__(**inputs)

def failing():
    return adapter(Failing())
"""
"""Filters of a task; the Jacobian of one is wrong, and one fails after 15 steps."""


@pytest.mark.long
def test_a_run_of_a_filter_that_fails_has_restarts(tmp_path: Path, open_client: Callable[..., TestClient]) -> None:
    (tmp_path / "boats.py").write_text(BOATS)
    source = f"{tmp_path}/boats.py"
    write_dataset(tmp_path / "short.h5", task(4), [sail(seed).part(0, 40) for seed in range(4)])
    settings = Settings(
        tmp_path / "workspace",
        data={"short": tmp_path / "short.h5"},
        checkpoints={"failing": load_external(f"{source}:failing", task(4))},
        tasks=(f"{source}:TASK",),
    )
    with open_client(settings) as client:
        while (reply := client.get("/api/trace/boat/failing/1")).status_code == 202:
            time.sleep(0.05)
        header = reply.json()
        client.post(url := "/api/failures/boat/failing?among=all")
        while (reply := client.get(url)).status_code == 202 and reply.json()["job"]["state"] != "failed":
            time.sleep(0.05)
        assert reply.status_code == 200, reply.text
        verdict = reply.json()["scores"][0]["verdict"]
    assert verdict.startswith("The filter fails and is restarted at the true state in 4 of 4 runs. ")
    reason = f"{source}:failing fails at step 15: ArithmeticError: not positive definite"
    assert header["steps"] == 40
    assert header["failure"] == {"failure": reason, "restarts": [15, 30]}


@pytest.mark.long
def test_a_filter_without_a_healthy_record_is_diagnosed_after_its_measurement(
    tmp_path: Path, open_client: Callable[..., TestClient]
) -> None:
    (tmp_path / "boats.py").write_text(BOATS)
    filters = {name: load_external(f"{tmp_path}/boats.py:{name}", task(4)) for name in ("right", "wrong")}
    write_dataset(tmp_path / "short.h5", task(4), [sail(seed).part(0, 30) for seed in range(10)])
    settings = Settings(
        tmp_path / "workspace",
        data={"short": tmp_path / "short.h5"},
        checkpoints=filters,
        tasks=(f"{tmp_path}/boats.py:TASK",),
    )
    record, url = "/api/healthy-record/boat/wrong", "/api/diagnosis/boat/wrong/5"
    with open_client(settings) as client:
        assert client.get(record).json() == {"job": None}
        while (reply := client.get(url)).status_code == 202:
            time.sleep(0.05)
        assert "this filter has no healthy record" in reply.text
        (defect,) = client.get(url.replace("diagnosis", "trace")).json()["defects"]
        assert defect.startswith("the Jacobian of radar differs from finite differences by ")
        job = client.post(record).json()["job"]
        assert job["title"] == "Healthy record of wrong, boat, 10 held-out episodes of short"
        assert wait_for_record(client, record) == "10 held-out episodes of short"
        result = client.get(url).json()
        assert result["state"] == "healthy"
        assert result["headline"].startswith("The Jacobian of radar differs from finite differences by ")
        assert "; otherwise no significant deviation from the record" in result["headline"]
        first = repair_record(settings)
        by_right = f"{record}?healthy_filter=right"
        job = client.post(by_right).json()["job"]  # a measured record again
        assert job["title"] == "Healthy record of wrong, boat, 10 held-out episodes of short, run by right"
        assert wait_for_record(client, by_right) == "10 held-out episodes of short, run by right"
        assert client.get(url).status_code == 202  # the diagnosis is computed again, too
        assert repair_record(settings) != first  # and the repair, whose bound is from the record
    with open_client(settings) as client:  # the record is kept in the workspace
        while (reply := client.get(url)).status_code == 202 and "progress" in reply.json():
            time.sleep(0.05)
        assert reply.json()["preliminary"]["causes"][0]["cause"] == "measurement.radar.jacobian", reply.text
    with closing(TraceStore(settings)) as store:
        checkpoint = store.checkpoint("boat", "wrong")
    assert required_profile(checkpoint).episodes == 10
    assert checkpoint.hash == filters["wrong"].hash


def wait_for_record(client: TestClient, url: str) -> Any:
    """The data of a healthy record, once its job is done."""
    end = time.monotonic() + TIMEOUT
    while (answer := client.get(url)).status_code == 202:
        assert answer.json()["job"]["state"] in ("waiting", "running"), answer.text
        assert time.monotonic() < end
        time.sleep(0.05)
    return answer.json()["data"]


def repair_record(settings: Settings) -> Any:
    """The version of the healthy record among the arguments of a repair."""
    with closing(TraceStore(settings)) as store:
        return _repair_arguments(store, Selection("boat", "wrong", 5))["record"]


def test_a_healthy_record_needs_ten_episodes(tmp_path: Path, open_client: Callable[..., TestClient]) -> None:
    with open_dataset(sample_path("door")) as data:
        write_dataset(tmp_path / "few.h5", data.task, [data[index] for index in range(7)])
    with open_client(Settings(workspace=tmp_path, data={"few": tmp_path / "few.h5"})) as client:
        reply = client.post("/api/healthy-record/door/hand-on-arc", params={"data": "few"})
        assert reply.status_code == 400
        assert "'few' has 7 held-out episodes; a healthy record needs at least 10" in reply.text


def test_unknown_names_are_reported(server: TestClient) -> None:
    for url, name in (
        ("/api/diagnosis/door/crossmodal-ekg/1", "crossmodal-ekg"),
        (f"{URL}?faults=image_frozzen", "image_frozzen"),
        (f"{URL}?over=all", "over"),
    ):
        reply = server.post(url)
        assert reply.status_code in (400, 404, 422)
        assert name in reply.text
