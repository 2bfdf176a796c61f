"""Reports over HTTP."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from typing import Any

import pytest
from httpx import Response
from starlette.testclient import TestClient

from beliefscope.app.runs.settings import Settings
from beliefscope.app.server.main import create_app
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.trace import trace
from beliefscope.inspect.traces.live_file import write_live

pytestmark = pytest.mark.slow

ORIGIN = "http://localhost:8000"
TIMEOUT = 120.0  # s, including the import of PyTorch by a job
OPTIONS = {"events": [7, 30], "title": "Two events"}


@pytest.mark.long
def test_report_is_written_downloaded_deleted_and_restored(settings: Settings) -> None:
    app = create_app(settings, warm=False)
    with TestClient(app, base_url=ORIGIN, headers={"Origin": ORIGIN}) as client:

        def request_report(**options: Any) -> Response:
            params = {"data": "mine", "faults": "blackout=0.4"}
            return client.post("/api/reports/door/crossmodal-ekf/1", params=params, json=OPTIONS | options)

        for options, status, message in (
            ({"events": [100]}, 400, "event step 100 does not exist: the run has steps 0 to 39"),
            ({"events": [-1]}, 422, "events"),
            ({"events": list(range(30))}, 422, "at most 20"),
            ({"sections": ["all"]}, 422, "sections"),
        ):
            answer = request_report(**options)
            assert (answer.status_code, message in answer.json()["error"]) == (status, True), answer.text
        response = request_report()
        assert response.status_code == 202
        job = response.json()["job"]
        assert client.get(f"/{job['link']}").status_code == 404
        end = time.monotonic() + TIMEOUT
        while (job := client.get(f"/api/jobs/{job['id']}").json())["state"] in ("waiting", "running"):
            assert time.monotonic() < end
            time.sleep(0.1)
        assert job["state"] == "done", job["error"]
        page = client.get(f"/{job['link']}")
        assert page.status_code == 200
        assert "attachment" in page.headers["content-disposition"]
        assert f"{ORIGIN}/?task=door&amp;filter=crossmodal-ekf&amp;data=mine&amp;episode=1&amp;step=" in page.text
        assert "faults=blackout%3D0.4" in page.text
        assert [f"episode=1&amp;step={step}" in page.text for step in (7, 30, 31)] == [True, True, False]
        assert "--event=7 --event=30 --title &#39;Two events&#39; -o report" in page.text
        assert request_report().json()["job"]["state"] == "done", "an existing report is not written again"
        (listed,) = client.get("/api/reports").json()["reports"]
        assert (f"/{job['link']}", "Two events", None) == (listed["url"], listed["title"], listed["pdf"])
        assert client.get(listed["url"].replace(".html", ".pdf")).status_code == 404
        run = tuple(listed[key] for key in ("task", "filter", "episode", "faults"))
        assert run == ("door", "crossmodal-ekf", 1, "blackout=0.4")
        inline = client.get(listed["url"], params={"inline": "true"})
        assert inline.headers["content-disposition"].startswith("inline")
        assert inline.headers["content-security-policy"].startswith("sandbox")
        id = client.delete(listed["url"]).json()["deleted"]
        assert client.get("/api/reports").json()["reports"] == []
        assert client.get(listed["url"]).status_code == 404
        restored = client.post(f"/api/reports/deleted/{id}").json()
        assert restored == {"name": listed["name"]}
        assert client.get("/api/reports").json() == {"reports": [listed], "deleted": []}
        client.delete(listed["url"])
        assert client.delete("/api/reports/deleted").json() == {"freed": listed["bytes"]}
        assert request_report().json()["job"]["state"] in ("waiting", "running"), "a deleted report is written again"
        assert client.get("/api/reports/door-nosuch-episode9-00000000.html").status_code == 404
        assert client.post("/api/reports/door/nosuch/9").status_code in (400, 404)


@pytest.mark.parametrize(("known", "name"), [(True, "image-ekf"), (False, "crossmodal-ekf (abcdef)")])
def test_the_filter_of_a_report_has_its_name_in_the_catalog(
    client: TestClient, settings: Settings, known: bool, name: str
) -> None:
    """A fine-tuned checkpoint has the name of its base checkpoint in its files."""
    (door,) = (task for task in client.get("/api/catalog").json()["tasks"] if task["name"] == "door")
    (hash_,) = (entry["checkpoint_hash"] for entry in door["filters"] if entry["name"] == "image-ekf")
    folder = settings.workspace / "reports" / "door-crossmodal-ekf-episode1-00000000"
    folder.mkdir(parents=True)
    manifest = {
        "title": "Report",
        "made": "2026-01-01T00:00:00+00:00",
        "task": "door",
        "filter": "crossmodal-ekf",
        "checkpoint_hash": hash_ if known else "abcdef" * 10,
        "traces": [{"episode": 1, "data_hash": "", "faults": []}],
        "files": {},
    }
    (folder / "manifest.json").write_text(json.dumps(manifest))
    (listed,) = client.get("/api/reports").json()["reports"]
    assert listed["filter"] == name


def test_the_run_of_a_report_has_the_episode_of_its_hash(client: TestClient, settings: Settings) -> None:
    """Several live runs have the same number of an episode."""
    with open_dataset(sample_path("door")) as data:
        run = trace(load_checkpoint(pretrained_path("door", "crossmodal-ekf")), data[9], 9)
    manifest: dict[str, Any] = {
        "title": "",
        "made": "2026-01-01T00:00:00+00:00",
        "task": "door",
        "filter": "own",
        "files": {},
    }
    (settings.workspace / "live").mkdir(parents=True)
    for i, hash_ in enumerate(["aa" * 32, "bb" * 32, run.data_hash]):
        if hash_ != run.data_hash:
            write_live(replace(run, data_hash=hash_), settings.workspace / "live" / f"{hash_[:2]}.live")
        folder = settings.workspace / "reports" / f"door-own-episode9-0000000{i}"
        folder.mkdir(parents=True)
        traces = [{"episode": 9, "data_hash": hash_, "faults": []}]
        (folder / "manifest.json").write_text(json.dumps({**manifest, "checkpoint_hash": "", "traces": traces}))
    reports = client.get("/api/reports").json()["reports"]
    assert {report["data_hash"][:2]: report["data"] for report in reports} == {
        "aa": "live:aa",
        "bb": "live:bb",
        run.data_hash[:2]: "sample",
    }
