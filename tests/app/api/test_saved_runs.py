"""Recordings of the page's own runs: with maps by a job; those that were only to be looked at go again."""

from __future__ import annotations

import time
from typing import Any

import pytest
from starlette.testclient import TestClient

from beliefscope.app.runs.trace_store import Settings
from beliefscope.app.workspace import recordings as rrdfiles

URL = "/api/recordings"
PATIENCE = 120.0  # s: a job imports PyTorch first


def listed(client: TestClient) -> dict[str, dict[str, Any]]:
    """By name. What the server wrote need not be read again: it is known at once."""
    found = client.get(URL).json()["recordings"]
    assert not any(one["reading"] for one in found)
    return {one["name"]: one for one in found}


def test_one_with_maps_is_made_by_a_job(client: TestClient, traced: str) -> None:
    wanted = {"task": "door", "filter": "crossmodal-pf", "episode": 1, "maps": 20}
    asked = client.post(URL, json=wanted)
    assert asked.status_code == 202
    job = asked.json()["job"]
    assert client.post(URL, json=wanted | {"automatic": True}).json()["job"]["id"] == job["id"], "the same file"
    end = time.monotonic() + PATIENCE
    while (job := client.get(f"/api/jobs/{job['id']}").json())["state"] in ("waiting", "running"):
        assert time.monotonic() < end
        time.sleep(0.1)
    assert job["state"] == "done", job["error"]
    made = client.post(URL, json=wanted)
    assert (made.status_code, made.json()["url"]) == (200, f"/{job['link']}")
    (found,) = client.get(URL).json()["recordings"]
    assert (found["name"], found["reading"], found["automatic"]) == (made.json()["name"], False, False)
    plain = client.post(URL, json=wanted | {"maps": 0}).json()["name"]
    assert found["entities"] > listed(client)[plain]["entities"], "it has maps"
    client.delete(found["url"])
    assert client.post(URL, json=wanted).status_code == 202, "what was deleted is made again"


def test_what_was_written_to_be_looked_at_goes_again_and_what_is_kept_stays(
    client: TestClient, traced: str, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rrdfiles, "AUTOMATIC", 2)
    wanted = {"task": "door", "filter": "crossmodal-pf", "episode": 1}

    def record(noise: int, automatic: bool = True) -> str:
        asked = wanted | {"faults": f"force_noise={noise}", "automatic": automatic}
        name: str = client.post(URL, json=asked).json()["name"]
        return name

    oldest, kept = record(1), record(2)
    assert record(2, automatic=False) == kept
    others = [record(3), record(4)]
    found = listed(client)
    assert {name: one["automatic"] for name, one in found.items()} == {kept: False} | dict.fromkeys(others, True)
    assert not (settings.workspace / "recordings" / ".about" / f"{oldest}.json").exists()
    assert client.patch(f"{URL}/{others[0]}", json={"automatic": False}).json()["automatic"] is False
    assert client.patch(f"{URL}/{others[1]}", json={"tags": ["x"]}).json()["automatic"] is False
    record(1)
    assert len(listed(client)) == 4, "nothing that is kept goes"
