"""Recordings of runs: likelihood maps."""

from __future__ import annotations

import time
from typing import Any

import pytest
from starlette.testclient import TestClient

pytestmark = pytest.mark.slow

URL = "/api/recordings"
TIMEOUT = 120.0  # s, including the import of PyTorch by a job


def listed(client: TestClient) -> dict[str, dict[str, Any]]:
    """Recordings by name. Metadata of files written by the server are available at once."""
    recordings = client.get(URL).json()["recordings"]
    assert not any(r["reading"] for r in recordings)
    return {r["name"]: r for r in recordings}


@pytest.mark.long
def test_recording_with_maps_is_a_job(client: TestClient, trace_url: str) -> None:
    body = {"task": "door", "filter": "crossmodal-pf", "episode": 1, "maps": 20}
    response = client.post(URL, json=body)
    assert response.status_code == 202
    job = response.json()["job"]
    assert client.post(URL, json=body).json()["job"]["id"] == job["id"], "the same file"
    end = time.monotonic() + TIMEOUT
    while (job := client.get(f"/api/jobs/{job['id']}").json())["state"] in ("waiting", "running"):
        assert time.monotonic() < end
        time.sleep(0.1)
    assert job["state"] == "done", job["error"]
    written = client.post(URL, json=body)
    assert (written.status_code, written.json()["url"]) == (200, f"/{job['link']}")
    (entry,) = client.get(URL).json()["recordings"]
    assert (entry["name"], entry["reading"]) == (written.json()["name"], False)
    plain = client.post(URL, json=body | {"maps": 0}).json()["name"]
    assert entry["entities"] > listed(client)[plain]["entities"], "it has maps"
    client.delete(entry["url"])
    assert client.post(URL, json=body).status_code == 202, "a deleted recording is written again"
