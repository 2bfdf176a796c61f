"""Catalog and traces over HTTP."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from beliefscope import __version__
from beliefscope.app.runs.settings import Settings
from beliefscope.app.server import main
from beliefscope.app.views.memory import freeze_heap
from beliefscope.datasets.faults.injection import Faults
from beliefscope.inspect.trace import load_trace

pytestmark = pytest.mark.slow

OpenClient = Callable[..., TestClient]


def columns(client: TestClient, url: str) -> dict[str, np.ndarray[Any, Any]]:
    descriptions = client.get(url).json()["columns"]
    buffer = client.get(f"{url}/columns").content
    return {
        c["name"]: np.frombuffer(buffer, "<f4", count=int(np.prod(c["shape"])), offset=c["offset"]).reshape(c["shape"])
        for c in descriptions
    }


def test_catalog(shared_client: TestClient, steps: int) -> None:
    catalog = shared_client.get("/api/catalog").json()
    assert catalog["version"] == __version__
    assert catalog["problems"] == []
    door = catalog["tasks"][0]
    assert [c["name"] for c in door["components"]] == ["hinge_x", "hinge_y", "angle"]
    assert door["map"] == {"components": ["hinge_x", "hinge_y"], "half_width": 0.135}
    assert door["main"] == {"name": "position", "key": "position_cm", "unit": "cm", "scale": 100.0, "indices": [0, 1]}
    filters = [(f["name"], f["kind"], f["metrics"]) for f in door["filters"][:2]]
    assert filters == [(f"crossmodal-{kind}", kind, {"position_cm": 1.5}) for kind in ("ekf", "pf")]
    mine, sample = door["data"]
    assert (mine["name"], mine["first"], sample["name"]) == ("mine", 1, "sample")
    assert [(e["index"], e["steps"], e["split"]) for e in mine["episodes"]] == [(0, steps, "train"), (1, steps, "test")]
    assert sample["episodes"][sample["first"]]["split"] == "test"
    assert sample["count"] == len(sample["episodes"])
    listed = shared_client.get("/api/episodes/door?data=mine&query=test").json()
    assert (listed["count"], [e["index"] for e in listed["episodes"]]) == (1, [1])
    assert shared_client.get("/api/episodes/door?data=none").status_code == 400


def test_columns_equal_the_trace(client: TestClient, trace_url: str, settings: Settings, steps: int) -> None:
    header = client.get(trace_url).json()
    (file,) = (settings.workspace / "traces").iterdir()
    trace = load_trace(file)
    assert header["steps"] == len(trace) == steps
    assert header["checkpoint_hash"] == trace.checkpoint_hash
    assert header["modalities"] == ["image", "haptics"]
    values = columns(client, trace_url)
    np.testing.assert_array_equal(values["truth"], trace.episode.states)
    np.testing.assert_array_equal(values["estimate_mean"], trace.estimate_mean)
    np.testing.assert_array_equal(values["effective_weights"], trace.effective_weights)
    np.testing.assert_array_equal(values["contact"], trace.episode.contact)
    np.testing.assert_array_equal(values["readings/force"], trace.episode.observations["force"])
    np.testing.assert_allclose(values["estimate_sigma"][:, 0] ** 2, trace.estimate_covariance[:, 0, 0], rtol=1e-5)
    assert trace.log_weights is not None
    np.testing.assert_allclose(
        values["effective_sample_size"], 1.0 / np.square(np.exp(trace.log_weights)).sum(axis=1), rtol=1e-4
    )
    images = np.frombuffer(client.get(f"{trace_url}/images").content, np.uint8).reshape(steps, 32, 32)
    np.testing.assert_array_equal(images, trace.episode.observations["image"])


def test_ekf_has_no_effective_sample_size(shared_client: TestClient) -> None:
    url = "/api/trace/door/crossmodal-ekf/0"
    while shared_client.get(url).status_code == 202:
        pass
    assert "effective_sample_size" not in columns(shared_client, url)


def test_trace_file_is_reused(client: TestClient, trace_url: str, settings: Settings, open_client: OpenClient) -> None:
    (file,) = (settings.workspace / "traces").iterdir()
    written = file.stat().st_mtime_ns
    with open_client(settings) as again:
        while again.get(trace_url).status_code == 202:
            pass
        assert columns(again, trace_url).keys() == columns(client, trace_url).keys()
    assert file.stat().st_mtime_ns == written


def test_damaged_trace_file_is_replaced(trace_url: str, settings: Settings, open_client: OpenClient) -> None:
    (file,) = (settings.workspace / "traces").iterdir()
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])
    with open_client(settings) as again:
        while (answer := again.get(trace_url)).status_code == 202:
            pass
        assert answer.status_code == 200
    assert len(file.read_bytes()) == len(content)


def test_faults_change_the_images(shared_client: TestClient, shared_trace_url: str) -> None:
    tasks = {t["name"]: t for t in shared_client.get("/api/catalog").json()["tasks"]}
    fault_sets = {r["name"]: r["faults"] for r in tasks["door"]["fault_presets"]}
    assert fault_sets["40 % image blackout"] == "blackout=0.4"
    for preset in tasks["door"]["fault_presets"]:
        assert preset["stored"] == str(Faults.parse(preset["faults"]))
    assert {"force axis stuck", "end-effector offset 2 cm", "haptics lost"} <= fault_sets.keys()
    clean = shared_client.get(f"{shared_trace_url}/images").content
    for faults in ("blackout=0.8", '[{"fault": "image_frozen", "from": 20}]'):
        query = {"faults": faults}
        while (answer := shared_client.get(shared_trace_url, params=query)).status_code == 202:
            pass
        assert answer.json()["faults"] == str(Faults.parse(faults))
        images = shared_client.get(f"{shared_trace_url}/images", params=query).content
        assert len(images) == len(clean)
        assert images != clean
    assert shared_client.get(shared_trace_url).json()["faults"] == ""
    assert shared_client.get(f"{shared_trace_url}/images").content == clean


@pytest.mark.parametrize(
    ("faults", "message"),
    [
        ("blakout", "fault 'blakout' does not exist. Did you mean blackout? Available: blackout,"),
        ("blackout=2", "blackout's 'probability' is 2, not a number from 0 to 1"),
        ("drop=touch", "modality 'touch' of task 'door' does not exist. Available: image, haptics."),
        ("[[", "faults is not JSON"),
        ("secret.json", "fault 'secret.json' does not exist"),
    ],
)
def test_invalid_faults_are_refused(
    shared_client: TestClient, shared_trace_url: str, faults: str, message: str
) -> None:
    body = {"task": "door", "filter": "crossmodal-pf", "episode": 1, "faults": faults}
    answers = [
        shared_client.get(shared_trace_url + part, params={"faults": faults}) for part in ("", "/columns", "/images")
    ]
    for answer in (*answers, shared_client.post("/api/recordings", json=body)):
        assert answer.status_code == 400
        assert message in answer.json()["error"]


@pytest.mark.parametrize("part", ["", "/columns", "/images"])
@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("nothing/crossmodal-pf/0", "task 'nothing' does not exist. Available: door"),
        ("door/crosmodal-pf/0", "filter 'crosmodal-pf' does not exist. Available: crossmodal-ekf, crossmodal-pf"),
        ("door/crossmodal-pf/2", "episode 2 does not exist. Available: 0 to 1."),
        ("door/crossmodal-pf/-1", "episode -1 does not exist."),
    ],
)
def test_unknown_names_are_refused(shared_client: TestClient, path: str, part: str, message: str) -> None:
    answer = shared_client.get(f"/api/trace/{path}{part}")
    assert answer.status_code == 400
    assert message in answer.json()["error"]
    assert "\n" not in answer.json()["error"]


@pytest.mark.parametrize(
    "path", ["/nowhere", "/scene/none/", "/static/none.js", "/static/0/none.js", "/api/recordings/x.rrd"]
)
def test_404_is_json(shared_client: TestClient, path: str) -> None:
    answer = shared_client.get(path)
    assert answer.status_code == 404
    assert answer.json()["error"]


def test_columns_have_an_etag(shared_client: TestClient, shared_trace_url: str) -> None:
    first = shared_client.get(f"{shared_trace_url}/columns")
    again = shared_client.get(f"{shared_trace_url}/columns", headers={"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_data_sets_with_equal_episode_indices(shared_client: TestClient, shared_trace_url: str) -> None:
    mine = columns(shared_client, shared_trace_url)["truth"]
    url = "/api/trace/door/crossmodal-pf/1?data="
    while (answer := shared_client.get(f"{url}sample")).status_code == 202:
        pass
    assert answer.json()["data_hash"] != shared_client.get(shared_trace_url).json()["data_hash"]
    assert (
        shared_client.get(f"{url}mine").json()["data_hash"] == shared_client.get(shared_trace_url).json()["data_hash"]
    )
    assert answer.json()["steps"] != len(mine)
    answer = shared_client.get(f"{url}yours")
    assert answer.status_code == 400
    assert answer.json()["error"] == "data 'yours' does not exist. Available: mine, sample."


@pytest.mark.parametrize("kind", ["data", "checkpoint"])
def test_damaged_input_file_is_reported(settings: Settings, tmp_path: Path, open_client: OpenClient, kind: str) -> None:
    bad = tmp_path / "bad"
    bad.write_bytes(b"damaged")
    if kind == "data":
        settings = replace(settings, data=settings.data | {"bad": bad})
    else:
        settings = replace(settings, checkpoints={**settings.checkpoints, "bad": bad})
    with open_client(settings, warm=True) as client:
        (problem,) = client.get("/api/catalog").json()["problems"]
        assert str(bad) in problem
        answer = client.get("/api/trace/door/crossmodal-pf/0?data=bad" if kind == "data" else "/api/trace/door/bad/0")
        assert answer.status_code == 400
        assert "'bad' does not exist. Available: " in answer.json()["error"]
        assert client.get("/api/trace/door/crossmodal-pf/0").status_code in (200, 202)


def test_first_trace_is_computed_at_startup(settings: Settings, open_client: OpenClient) -> None:
    with open_client(settings, warm=True):
        deadline = time.monotonic() + 30.0
        while not list((settings.workspace / "traces").glob("door-crossmodal-ekf-episode1-*.trace")):
            assert time.monotonic() < deadline
            time.sleep(0.05)


@pytest.mark.long
def test_stopped_server_leaves_no_frozen_objects(
    settings: Settings, open_client: OpenClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At exit, DuckDB reports objects that are never freed as leaks."""
    frozen: list[int] = []

    def warm(*_: object) -> None:
        freeze_heap()
        frozen.append(gc.get_freeze_count())

    monkeypatch.setattr(main, "_warm", warm)
    with open_client(settings, warm=True):
        pass
    assert frozen[0] > 0
    assert gc.get_freeze_count() == 0
