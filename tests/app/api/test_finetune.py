"""Fine-tuning over HTTP: a run is a job, its child is held against the parent, and what becomes of it is remembered."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import pytest
from starlette.testclient import TestClient

from beliefscope.app.api.finetune import Diary
from beliefscope.app.server.main import Settings
from beliefscope.filters.checkpoint import load_checkpoint

PATIENCE = 120.0  # s: a job imports PyTorch first
URL = "/api/finetune/door/crossmodal-ekf"
SMALL = {"train": ["haptics-only"], "steps": 4, "check": 2, "length": 8, "windows": 2}
BLACK = {"slice": {"name": "black", "faults": [{"fault": "blackout", "probability": 1.0}]}, "share": 1.0}


def finished(client: TestClient, run: str) -> Any:
    """The run, once its job has ended."""
    end = time.monotonic() + PATIENCE
    while (shown := client.get(f"/api/tuned/{run}").json())["job"]["state"] in ("waiting", "running"):
        assert time.monotonic() < end
        time.sleep(0.05)
    return shown


def filters(client: TestClient) -> list[str]:
    tasks = client.get("/api/catalog").json()["tasks"]
    return [one["name"] for one in next(task for task in tasks if task["name"] == "door")["filters"]]


def test_what_can_be_trained_is_a_tree_with_presets_and_slices(client: TestClient) -> None:
    offer = client.get(URL).json()
    assert offer["why_not"] is None
    names = [one["name"] for one in offer["modules"]]
    assert {"dynamics", "virtual_sensors.haptics.state", "weight_model"} <= set(names)
    presets = {one["name"]: one["trains"] for one in offer["presets"]}
    assert {"haptics-only", "image-only", "weights-only", "noise-only", "dynamics-only", "heads-only", "all"} <= set(
        presets
    )
    assert "virtual_sensors.haptics.state.weight" in presets["haptics-only"]
    assert not any(name.startswith("virtual_sensors.image") for name in presets["haptics-only"])
    assert "haptics alone" in [one["name"] for one in offer["slices"]]
    assert offer["runs"] == []


@pytest.mark.long
def test_a_child_is_made_held_against_its_parent_and_placed(
    settings: Settings, open_client: Callable[..., TestClient]
) -> None:
    parent = load_checkpoint(settings.checkpoints["crossmodal-ekf"])  # type: ignore[arg-type]
    with open_client(settings) as client:
        before = filters(client)
        asked = client.post(URL, json=SMALL | {"mix": [BLACK]})
        assert asked.status_code == 202, asked.text
        run = asked.json()["run"]
        assert client.post(f"/api/tuned/{run}/accept").status_code == 409
        shown = finished(client, run)
        assert shown["job"]["state"] == "done", shown["job"]
        assert [step for step, _ in shown["progress"]["losses"]][-1] == 4
        assert set(shown["progress"]["looks"][0]["slices"]) == {"nominal", "black"}
        found, name = shown["found"], shown["child"]
        assert found["child"]["name"] == name
        assert "virtual_sensors.image" in found["frozen"]
        assert "black" in {
            row[0] for t in found["change"]["tables"] if t["title"].startswith("Errors") for row in t["rows"]
        }
        for moment in found["moments"]:
            link = dict(parse_qsl(moment["link"][1:]))
            alone = f"from=0&to={moment['last'] + 1}&weights={moment['only'][0]}%3D1" if moment["only"] else None
            assert (link["filter"], link["against"]) == (name, alone or "filter=crossmodal-ekf")
        path = settings.workspace / "finetune" / run / "child.safetensors"
        assert load_checkpoint(path).record["parent"]["hash"] == parent.hash
        assert list((path.parent / "log").iterdir())
        assert client.post(URL, json=SMALL | {"mix": [BLACK]}).json()["job"]["id"] == shown["job"]["id"]

        assert filters(client) == before
        assert client.post(f"/api/tuned/{run}/keep").json()["place"] == "kept"
        assert filters(client)[: len(settings.checkpoints) + 1] == [*settings.checkpoints, name]
        assert client.post(f"/api/tuned/{run}/accept").json()["place"] == "default"
        assert filters(client)[0] == name
        assert client.get(f"/api/finetune/door/{name}").json()["runs"][0]["run"] == run
    with open_client(settings) as client:
        assert filters(client)[0] == name, "another server on the same workspace shows it too"
        assert client.post(f"/api/tuned/{run}/roll-back").json()["place"] is None
        assert filters(client) == before
        assert path.is_file()
        client.delete(f"/api/jobs/{shown['job']['id']}")
        again = client.get(f"/api/tuned/{run}").json()
        assert (again["job"], again["found"]) == (None, found), "a child outlasts its job"
    assert load_checkpoint(settings.checkpoints["crossmodal-ekf"]).hash == parent.hash  # type: ignore[arg-type]


def test_a_run_that_was_stopped_keeps_the_losses_of_its_steps(tmp_path: Path) -> None:
    before = Diary(tmp_path, 9)
    for step in range(1, 6):
        before.step(step, 1.0 / step)
    before.write()
    after = Diary(tmp_path, 9)
    after.resume(4)  # its last look; the fifth step is done anew
    after.step(5, 0.25)
    after.write()
    losses = json.loads((tmp_path / "progress.json").read_text())["losses"]
    assert losses == [[1, 1.0], [2, 0.5], [3, pytest.approx(1 / 3)], [4, 0.25], [5, 0.25]]


@pytest.mark.parametrize(
    ("body", "told"),
    [
        ({"steps": 0}, "steps of a fine-tuning is 0"),
        ({"train": ["haptic-only"]}, "Did you mean haptics-only"),
        ({"nonsense": 1}, "does not exist. Available: train, freeze"),
        ({"mix": [{"slice": {"name": "a", "only": ["touch"]}, "share": 1.0}]}, "Available: image, haptics"),
    ],
)
def test_what_cannot_be_is_said_before_a_job_is_made(client: TestClient, body: dict[str, Any], told: str) -> None:
    answer = client.post(URL, json=body)
    assert answer.status_code == 400
    assert told in answer.json()["error"]
    assert client.get("/api/jobs").json() == []


def test_a_run_that_is_not_there_is_404(client: TestClient) -> None:
    assert client.get("/api/tuned/0123").status_code == 404
    assert client.post("/api/tuned/0123/keep").status_code == 404
