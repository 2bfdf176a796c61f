"""The other run over HTTP: another filter, other faults, an edit over some steps."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from beliefscope.app.runs.trace_store import Selection, Settings
from beliefscope.app.server.main import create_app
from beliefscope.app.views.scene import Scene
from beliefscope.app.views.scene_belief import OUTLINES
from beliefscope.app.views.scene_comparison import dashed
from beliefscope.datasets.faults.injection import Faults
from beliefscope.inspect.traces.replay import Edit

ORIGIN = "http://localhost:8000"
EPISODE = 9
EDIT = "from=40&to=60&faults=blackout"
EKF = f"door/crossmodal-ekf/{EPISODE}"


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    app = create_app(Settings(tmp_path_factory.mktemp("workspace"), particles=30), warm=False)
    with TestClient(app, base_url=ORIGIN, headers={"Origin": ORIGIN}) as client:
        yield client


def answered(client: TestClient, address: str, **query: Any) -> Any:
    end = time.monotonic() + 60.0
    while (answer := client.get(address, params=query)).status_code == 202:
        assert 0.0 <= answer.json()["progress"] <= 1.0
        assert time.monotonic() < end
    return answer


def compared(client: TestClient, against: str, of: str = EKF, **query: Any) -> dict[str, Any]:
    answer = answered(client, f"/api/compare/{of}", against=against, **query)
    assert answer.status_code == 200, answer.text
    return answer.json()


def estimate(client: TestClient, of: str = EKF, **query: Any) -> np.ndarray[Any, Any]:
    """(T, n)"""
    header = answered(client, f"/api/trace/{of}", **query).json()
    column = next(c for c in header["columns"] if c["name"] == "estimate_mean")
    data = client.get(f"/api/trace/{of}/columns", params=query).content
    count = int(np.prod(column["shape"]))
    return np.frombuffer(data, "<f4", count, column["offset"]).reshape(column["shape"])


@pytest.mark.parametrize("filter_", ["crossmodal-ekf", "crossmodal-pf"])
def test_an_edit_changes_nothing_before_it(shown: TestClient, filter_: str) -> None:
    of = f"door/{filter_}/{EPISODE}"
    original, edited = estimate(shown, of), estimate(shown, of, against=EDIT)
    assert np.array_equal(original[:40], edited[:40])
    assert (original[40:60] != edited[40:60]).any(axis=1).all()
    found = compared(shown, EDIT, of)
    assert found["names"] == ["original", "edited"]
    distance = np.array(next(c["values"] for c in found["curves"] if c["name"] == "fused"))
    assert not distance[:40].any()
    assert distance[40:60].all()
    assert [t for t, edit in enumerate(found["bands"]["edit"]) if edit] == list(range(40, 60))
    assert "haptics" in found["verdict"]


def test_an_edit_is_the_faults_over_its_span(shown: TestClient) -> None:
    whole = estimate(shown, faults="blackout:from=40:to=60")
    assert np.array_equal(estimate(shown, against=EDIT), whole)


def test_weights_by_hand(shown: TestClient) -> None:
    against = "from=40&to=60&weights=haptics=0.75"
    header = answered(shown, f"/api/trace/{EKF}", against=against).json()
    column = next(c for c in header["columns"] if c["name"] == "weights")
    data = shown.get(f"/api/trace/{EKF}/columns", params={"against": against}).content
    weights = np.frombuffer(data, "<f4", int(np.prod(column["shape"])), column["offset"]).reshape(column["shape"])
    np.testing.assert_allclose(weights[40:60, header["modalities"].index("haptics")], 0.75, atol=1e-6)


@pytest.mark.parametrize(
    ("against", "query", "names"),
    [
        ("filter=crossmodal-pf", {}, ["crossmodal-ekf", "crossmodal-pf"]),
        ("faults=blackout=0.5", {}, ["as recorded", "blackout=0.5"]),
        ("faults=", {"faults": "blackout=0.5"}, ["blackout=0.5", "as recorded"]),
        (
            "filter=crossmodal-pf&faults=",
            {"faults": "blackout"},
            ["crossmodal-ekf, blackout", "crossmodal-pf, as recorded"],
        ),
    ],
)
def test_another_filter_or_other_faults(
    shown: TestClient, against: str, query: dict[str, str], names: list[str]
) -> None:
    found = compared(shown, against, **query)
    assert found["names"] == names
    (table,) = found["tables"]
    assert table["columns"][2:4] == names
    other = answered(shown, f"/api/trace/{EKF}", against=against, **query).json()
    assert [other["filter"], other["faults"] or "as recorded"] == [
        "crossmodal-pf" if "filter=" in against else "crossmodal-ekf",
        "blackout=0.5" if against == "faults=blackout=0.5" else "as recorded",
    ]


@pytest.mark.parametrize(
    ("against", "said"),
    [
        ("filter=crossmodal-ekf", "is the run that is shown"),
        ("filter=kalman", "'kalman'"),
        ("faults=lightning", "lightning"),
        ("speed=3", "part of the other run"),
        ("from=40&to=60", "nothing is edited"),
        ("from=40&faults=blackout", "'to' of the edit"),
        ("from=60&to=40&faults=blackout", "has no steps"),
        ("from=40&to=5000&faults=blackout", "beyond this trace"),
        ("from=40&to=60&weights=touch=1", "touch"),
        ("from=40&to=60&weights=image=2", "from 0 to 1"),
        ("from=40&to=60&filter=crossmodal-pf&faults=blackout", "part of an edit"),
        ("from=40&to=60&faults=blackout:from=2", "span of its own"),
    ],
)
def test_what_cannot_be_compared_is_said(shown: TestClient, against: str, said: str) -> None:
    for route in ("trace", "compare"):
        answer = answered(shown, f"/api/{route}/{EKF}", against=against)
        assert answer.status_code == 400
        assert said in answer.json()["error"]


def test_a_selection_knows_its_other_run() -> None:
    selection = Selection("door", "crossmodal-ekf", EPISODE)
    edited = selection.against("from=40&to=60&faults=blackout&weights=image=0.5")
    assert edited == replace(selection, edit=Edit(40, 60, Faults.parse("blackout"), {"image": 0.5}))
    assert len({selection, edited, selection.against("from=40&to=60&faults=blackout&weights=image=0.6")}) == 3


@pytest.mark.parametrize("shape", OUTLINES)
def test_dashes_lie_on_their_edges_and_cover_about_half(shape: str) -> None:
    edges = np.asarray(OUTLINES[shape])  # of size 1 m: a box has long edges alone
    dashes = dashed(edges)
    lengths = [np.linalg.norm(lines[:, 1] - lines[:, 0], axis=-1) for lines in (edges, dashes)]
    assert 0.4 < lengths[1].sum() / lengths[0].sum() < 0.7
    ends = dashes.reshape(-1, 1, 3)
    along = (edges[:, 1] - edges[:, 0]) / lengths[0][:, None]
    away = ends - edges[None, :, 0]
    on = np.clip((away * along).sum(-1, keepdims=True), 0.0, lengths[0][:, None])
    assert np.linalg.norm(away - on * along, axis=-1).min(axis=1).max() < 1e-6


def test_the_scene_shows_the_other_run_where_it_is(shown: TestClient) -> None:
    library = shown.app.state.library  # type: ignore[attr-defined]
    selection = Selection("door", "crossmodal-ekf", EPISODE)
    traced, its = library.traced(selection), library.traced(selection.against("filter=crossmodal-pf"))
    other = its.trace
    assert library.there(selection.against("filter=crossmodal-pf")) is its
    assert library.there(selection.against("from=1&to=3&weights=image=0.123")) is None
    scene = Scene(lambda step: None, dark=False)
    try:
        scene.show(traced, 45, other)
        nodes = scene.viser.server.scene._handle_from_node_name
        there = {name: nodes[name] for name in ("/other/pole", "/other/ghost")}
        ghost = traced.checkpoint.task.ghost
        assert ghost is not None
        placed = ghost(other.estimate_mean)
        np.testing.assert_allclose(there["/other/ghost"].position, placed.position[45], atol=1e-6)
        np.testing.assert_allclose(there["/other/pole"].position[:2], placed.anchor[45, :2], atol=1e-6)
        scene.show(traced, 46)
        assert not any(name.startswith("/other") for name in nodes)
    finally:
        scene.close()


def test_maps_of_the_other_run_come_before_this_ones(shown: TestClient) -> None:
    against = "filter=crossmodal-pf"
    compared(shown, against)
    view = shown.post("/api/views").json()
    cursor = {
        "type": "cursor",
        "task": "door",
        "filter": "crossmodal-ekf",
        "episode": EPISODE,
        "step": 45,
        "angle": None,
    }
    with shown.websocket_connect(f"ws://localhost:8000{view['socket']}") as socket:
        for serial, extra in enumerate(({}, {"against": against}, {"against": against, "beside": True})):
            socket.send_json({**cursor, "serial": serial, "size": 41, "scene": False, **extra})
            of = [header(socket.receive_bytes()) for _ in range(1 + len(extra) // 2)]
            assert [one["other"] for one in of] == [True, False][-len(of) :]
            assert {one["serial"] for one in of} == {serial}
        alone = {**cursor, "filter": "crossmodal-pf", "serial": 9, "size": 41, "scene": False}
        socket.send_json(alone)
        assert header(socket.receive_bytes())["peak"] == of[0]["peak"] != of[1]["peak"]


def header(message: bytes) -> dict[str, Any]:
    size = int.from_bytes(message[:4], "little")
    found: dict[str, Any] = json.loads(message[4 : 4 + size])
    return found
