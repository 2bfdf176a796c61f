"""Fine-tuning over HTTP: options, runs, results, and saving the fine-tuned filter."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import pytest
from starlette.testclient import TestClient

from beliefscope.app.runs.settings import Settings
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.filters.checkpoint import load_checkpoint
from beliefscope.inspect.compare.progress_log import ProgressLog

pytestmark = pytest.mark.slow

TIMEOUT = 120.0  # s, including the import of PyTorch by a job
URL = "/api/finetune/door/crossmodal-ekf"
SMALL = {"train": ["haptics-only"], "steps": 4, "check": 2, "length": 8, "windows": 2}
BLACKOUT = {"slice": {"name": "blackout", "faults": [{"fault": "blackout", "probability": 1.0}]}, "share": 1.0}


def wait_for(client: TestClient, run: str) -> Any:
    """The run when its job has ended."""
    end = time.monotonic() + TIMEOUT
    while (details := client.get(f"/api/tuned/{run}").json())["job"]["state"] in ("waiting", "running"):
        assert time.monotonic() < end
        time.sleep(0.05)
    return details


def filters(client: TestClient) -> list[str]:
    tasks = client.get("/api/catalog").json()["tasks"]
    return [f["name"] for f in next(task for task in tasks if task["name"] == "door")["filters"]]


def test_injected_faults_are_offered_as_a_weakness(shared_client: TestClient) -> None:
    url, faults = "/api/weaknesses/door/crossmodal-ekf/0", "force_noise=30:from=3"
    end = time.monotonic() + TIMEOUT
    while (reply := shared_client.get(url, params={"faults": faults})).status_code == 202:  # the run is computed
        assert time.monotonic() < end
        time.sleep(0.05)
    first = next(weakness for weakness in reply.json() if weakness["source"] != "diagnosis")
    assert (first["source"], first["episode"]) == ("faults", 0)
    assert first["title"] == "Injected faults \u201cforce_noise 30 from 3\u201d"
    assert [slice_["name"] for slice_ in first["slices"]] == ["force_noise 30 from 3"]
    assert "force_noise 30 from 3" in first["settings"]["success"]
    clean = shared_client.get(url)
    while clean.status_code == 202:
        clean = shared_client.get(url)
    assert all(weakness["source"] != "faults" for weakness in clean.json())


def test_options(shared_client: TestClient) -> None:
    offer = shared_client.get(URL).json()
    assert offer["why_not"] is None
    names = [m["name"] for m in offer["modules"]]
    assert {"dynamics", "virtual_sensors.haptics.state", "weight_model"} <= set(names)
    presets = {p["name"]: p["trains"] for p in offer["presets"]}
    assert {
        "haptics-only",
        "image-only",
        "weights-only",
        "noise-only",
        "reliability-only",
        "dynamics-only",
        "heads-only",
        "all",
    } <= set(presets)
    assert "virtual_sensors.haptics.state.weight" in presets["haptics-only"]
    assert not any(name.startswith("virtual_sensors.image") for name in presets["haptics-only"])
    assert "haptics only" in [m["name"] for m in offer["slices"]]
    assert offer["runs"] == []


@pytest.mark.long
def test_run_without_improvement_cannot_be_promoted(client: TestClient) -> None:
    # A learning rate this large ruins the weights, so that the base checkpoint is best.
    run = client.post(URL, json=SMALL | {"mix": [BLACKOUT], "rate": 100.0}).json()["run"]
    details = wait_for(client, run)
    assert details["job"]["state"] == "done", details["job"]
    advice = details["result"]["finetuned"]["no_change"]
    assert advice.startswith("No change: the base checkpoint was best. Try ")
    before = filters(client)
    for action in ("promote", "save"):
        response = client.post(f"/api/tuned/{run}/{action}")
        assert response.status_code == 409
        assert advice in response.json()["error"]
    assert filters(client) == before


@pytest.mark.long
def test_run_is_compared_with_its_base_and_saved(settings: Settings, open_client: Callable[..., TestClient]) -> None:
    base = load_checkpoint(settings.checkpoints["crossmodal-ekf"])  # type: ignore[arg-type]
    with open_client(settings) as client:
        before = filters(client)
        response = client.post(URL, json=SMALL | {"mix": [BLACKOUT]})
        assert response.status_code == 202, response.text
        run = response.json()["run"]
        assert client.post(f"/api/tuned/{run}/promote").status_code == 409
        details = wait_for(client, run)
        assert details["job"]["state"] == "done", details["job"]
        assert [step for step, _ in details["progress"]["losses"]][-1] == 4
        assert set(details["progress"]["validations"][0]["slices"]) == {"clean", "blackout"}
        result, name = details["result"], details["finetuned"]
        assert result["finetuned"]["name"] == name
        assert "virtual_sensors.image" in result["frozen"]
        assert "blackout" in {
            row[0] for t in result["comparison"]["tables"] if t["title"].startswith("Errors") for row in t["rows"]
        }
        for event in result["events"]:
            link = dict(parse_qsl(event["link"][1:]))
            weights = f"from=0&to={event['last'] + 1}&weights={event['only'][0]}%3D1" if event["only"] else None
            assert (link["filter"], link["against"]) == (name, weights or "filter=crossmodal-ekf")
        path = settings.workspace / "finetune" / run / "finetuned.safetensors"
        assert load_checkpoint(path).record["base"]["hash"] == base.hash
        assert list((path.parent / "log").iterdir())
        assert client.post(URL, json=SMALL | {"mix": [BLACKOUT]}).json()["job"]["id"] == details["job"]["id"]

        assert filters(client) == before
        assert client.post(f"/api/tuned/{run}/save").json()["saved_as"] == "saved"
        assert filters(client)[: len(settings.checkpoints) + 1] == [*settings.checkpoints, name]
        assert client.post(f"/api/tuned/{run}/promote").json()["saved_as"] == "default"
        assert filters(client)[0] == name
        assert client.get(f"/api/finetune/door/{name}").json()["runs"][0]["run"] == run
    with open_client(settings) as client:
        assert filters(client)[0] == name, "saved for later servers, too"
        assert client.post(f"/api/tuned/{run}/discard").json()["saved_as"] is None
        assert filters(client) == before
        assert path.is_file()
        client.delete(f"/api/jobs/{details['job']['id']}")
        again = client.get(f"/api/tuned/{run}").json()
        assert (again["job"], again["result"]) == (None, result), "the result outlasts its job"
    assert load_checkpoint(settings.checkpoints["crossmodal-ekf"]).hash == base.hash  # type: ignore[arg-type]


def test_interrupted_run_keeps_its_losses(tmp_path: Path) -> None:
    path = tmp_path / "progress.json"
    before = ProgressLog(path, 9, DOOR.main_error)
    for step in range(1, 6):
        before.add_step(step, 1.0 / step)
    before.write()
    after = ProgressLog(path, 9, DOOR.main_error)
    after.resume(4)  # the last validation; the fifth step is repeated
    after.add_step(5, 0.25)
    after.write()
    losses = json.loads(path.read_text())["losses"]
    assert losses == [[1, 1.0], [2, 0.5], [3, pytest.approx(1 / 3)], [4, 0.25], [5, 0.25]]


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ({"steps": 0}, "steps of a fine-tuning run is 0"),
        ({"train": ["haptic-only"]}, "Did you mean haptics-only"),
        ({"nonsense": 1}, "does not exist. Available: train, freeze"),
        ({"mix": [{"slice": {"name": "a", "only": ["touch"]}, "share": 1.0}]}, "Available: image, haptics"),
    ],
)
def test_invalid_settings_create_no_job(client: TestClient, body: dict[str, Any], message: str) -> None:
    answer = client.post(URL, json=body)
    assert answer.status_code == 400
    assert message in answer.json()["error"]
    assert client.get("/api/jobs").json() == []


def test_unknown_run_is_404(shared_client: TestClient) -> None:
    assert shared_client.get("/api/tuned/0123").status_code == 404
    assert shared_client.post("/api/tuned/0123/save").status_code == 404
