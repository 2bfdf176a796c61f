"""Comparison runs over HTTP: another filter, other faults, or an intervention."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.settings import Settings
from beliefscope.app.server.main import create_app
from beliefscope.app.views.scene import Scene
from beliefscope.datasets.faults.injection import Faults
from beliefscope.inspect.figures.scene_shapes import OUTLINE_EDGES, dashed
from beliefscope.inspect.traces.replay import Intervention

pytestmark = pytest.mark.slow

ORIGIN = "http://localhost:8000"
EPISODE = 9
EDIT = "from=40&to=60&faults=blackout"
EKF = f"door/crossmodal-ekf/{EPISODE}"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    app = create_app(Settings(tmp_path_factory.mktemp("workspace"), particles=30), warm=False)
    with TestClient(app, base_url=ORIGIN, headers={"Origin": ORIGIN}) as client:
        yield client


def poll(client: TestClient, address: str, **query: Any) -> Any:
    end = time.monotonic() + 60.0
    while (answer := client.get(address, params=query)).status_code == 202:
        assert 0.0 <= answer.json()["progress"] <= 1.0
        assert time.monotonic() < end
    return answer


def compare(client: TestClient, against: str, run: str = EKF, **query: Any) -> dict[str, Any]:
    answer = poll(client, f"/api/compare/{run}", against=against, **query)
    assert answer.status_code == 200, answer.text
    return answer.json()


def estimate(client: TestClient, run: str = EKF, **query: Any) -> np.ndarray[Any, Any]:
    """(T, n)"""
    header = poll(client, f"/api/trace/{run}", **query).json()
    column = next(c for c in header["columns"] if c["name"] == "estimate_mean")
    data = client.get(f"/api/trace/{run}/columns", params=query).content
    count = int(np.prod(column["shape"]))
    return np.frombuffer(data, "<f4", count, column["offset"]).reshape(column["shape"])


@pytest.mark.parametrize("filter_", ["crossmodal-ekf", "crossmodal-pf"])
def test_intervention_does_not_affect_earlier_steps(server: TestClient, filter_: str) -> None:
    run = f"door/{filter_}/{EPISODE}"
    original, counterfactual = estimate(server, run), estimate(server, run, against=EDIT)
    assert np.array_equal(original[:40], counterfactual[:40])
    assert (original[40:60] != counterfactual[40:60]).any(axis=1).all()
    result = compare(server, EDIT, run)
    assert result["names"] == ["original", "with intervention"]
    distance = np.array(next(c["values"] for c in result["curves"] if c["name"] == "fused"))
    assert not distance[:40].any()
    assert distance[40:60].all()
    assert [t for t, intervention in enumerate(result["bands"]["intervention"]) if intervention] == list(range(40, 60))
    assert "haptics" in result["verdict"]


def test_intervention_equals_faults_over_its_span(server: TestClient) -> None:
    expected = estimate(server, faults="blackout:from=40:to=60")
    assert np.array_equal(estimate(server, against=EDIT), expected)


def test_manual_weights(server: TestClient) -> None:
    against = "from=40&to=60&weights=haptics=0.75"
    header = poll(server, f"/api/trace/{EKF}", against=against).json()
    column = next(c for c in header["columns"] if c["name"] == "weights")
    data = server.get(f"/api/trace/{EKF}/columns", params={"against": against}).content
    weights = np.frombuffer(data, "<f4", int(np.prod(column["shape"])), column["offset"]).reshape(column["shape"])
    np.testing.assert_allclose(weights[40:60, header["modalities"].index("haptics")], 0.75, atol=1e-6)


@pytest.mark.parametrize(
    ("against", "query", "names"),
    [
        ("filter=crossmodal-pf", {}, ["crossmodal-ekf", "crossmodal-pf"]),
        ("faults=blackout=0.5", {}, ["as recorded", "blackout=0.5"]),
        ("only=haptics", {}, ["all modalities", "haptics standalone"]),
        ("faults=", {"faults": "blackout=0.5"}, ["blackout=0.5", "as recorded"]),
        (
            "filter=crossmodal-pf&faults=",
            {"faults": "blackout"},
            ["crossmodal-ekf, blackout", "crossmodal-pf, as recorded"],
        ),
    ],
)
def test_compare_with_another_filter_or_other_faults(
    server: TestClient, against: str, query: dict[str, str], names: list[str]
) -> None:
    result = compare(server, against, **query)
    assert result["names"] == names
    (table,) = result["tables"]
    assert table["columns"][2:4] == names
    other = poll(server, f"/api/trace/{EKF}", against=against, **query).json()
    assert [other["filter"], other["faults"] or "as recorded"] == [
        "crossmodal-pf" if "filter=" in against else "crossmodal-ekf",
        "blackout=0.5" if against == "faults=blackout=0.5" else "as recorded",
    ]


@pytest.mark.parametrize(
    ("against", "message"),
    [
        ("filter=crossmodal-ekf", "describes the selected run"),
        ("filter=kalman", "'kalman'"),
        ("faults=lightning", "lightning"),
        ("speed=3", "the comparison run"),
        ("only=touch", "Modality 'touch' is not in this filter. Available: image, haptics."),
        ("only=image&filter=crossmodal-pf", "only= names one modality"),
        ("from=40&to=60", "is empty: give faults"),
        ("from=40&faults=blackout", "'to' of intervention"),
        ("from=60&to=40&faults=blackout", "has no steps"),
        ("from=40&to=5000&faults=blackout", "after the last step of this episode"),
        ("from=40&to=60&weights=touch=1", "touch"),
        ("from=40&to=60&weights=image=2", "must be between 0 and 1"),
        ("from=40&to=60&filter=crossmodal-pf&faults=blackout", "part 'filter' of an intervention"),
        ("from=40&to=60&faults=blackout:from=2", "has its own steps"),
    ],
)
def test_invalid_comparison_is_reported(server: TestClient, against: str, message: str) -> None:
    for route in ("trace", "compare"):
        answer = poll(server, f"/api/{route}/{EKF}", against=against)
        assert answer.status_code == 400
        assert message in answer.json()["error"]


def test_selection_of_comparison_run() -> None:
    selection = Selection("door", "crossmodal-ekf", EPISODE)
    counterfactual = selection.comparison("from=40&to=60&faults=blackout&weights=image=0.5")
    expected = Intervention(40, 60, Faults.parse("blackout"), {"image": 0.5})
    assert counterfactual == replace(selection, intervention=expected)
    assert Selection.from_json(counterfactual.to_json()) == counterfactual
    assert "edit" in counterfactual.to_json(), "the key of stored jobs"
    other = selection.comparison("from=40&to=60&faults=blackout&weights=image=0.6")
    assert len({selection, counterfactual, other}) == 3


@pytest.mark.parametrize("shape", OUTLINE_EDGES)
def test_dashes_cover_half_of_their_edges(shape: str) -> None:
    edges = np.asarray(OUTLINE_EDGES[shape])  # of size 1 m
    dashes = dashed(edges)
    lengths = [np.linalg.norm(lines[:, 1] - lines[:, 0], axis=-1) for lines in (edges, dashes)]
    assert 0.4 < lengths[1].sum() / lengths[0].sum() < 0.7
    ends = dashes.reshape(-1, 1, 3)
    along = (edges[:, 1] - edges[:, 0]) / lengths[0][:, None]
    offset = ends - edges[None, :, 0]
    distance = np.clip((offset * along).sum(-1, keepdims=True), 0.0, lengths[0][:, None])
    assert np.linalg.norm(offset - distance * along, axis=-1).min(axis=1).max() < 1e-6


def test_scene_shows_comparison_run(server: TestClient) -> None:
    store = server.app.state.store  # type: ignore[attr-defined]
    selection = Selection("door", "crossmodal-ekf", EPISODE)
    run, other_run = store.request(selection), store.request(selection.comparison("filter=crossmodal-pf"))
    other = other_run.trace
    assert store.cached(selection.comparison("filter=crossmodal-pf")) is other_run
    assert store.cached(selection.comparison("from=1&to=3&weights=image=0.123")) is None
    scene = Scene(dark=False)
    try:
        scene.show(run, 45, other)
        nodes = scene.viser.server.scene._handle_from_node_name
        handles = {name: nodes[name] for name in ("/other/pole", "/other/outline")}
        outline = run.checkpoint.task.outline
        assert outline is not None
        placed = outline(other.estimate_mean)
        np.testing.assert_allclose(handles["/other/outline"].position, placed.position[45], atol=1e-6)
        np.testing.assert_allclose(handles["/other/pole"].position[:2], placed.anchor[45, :2], atol=1e-6)
        scene.show(run, 46)
        assert not any(name.startswith("/other") for name in nodes)
    finally:
        scene.close()


def test_maps_of_comparison_run_are_sent_first(server: TestClient) -> None:
    against = "filter=crossmodal-pf"
    compare(server, against)
    view = server.post("/api/views").json()
    cursor = {
        "type": "cursor",
        "task": "door",
        "filter": "crossmodal-ekf",
        "episode": EPISODE,
        "step": 45,
        "angle": None,
    }
    with server.websocket_connect(f"ws://localhost:8000{view['socket']}") as socket:
        for serial, extra in enumerate(({}, {"against": against}, {"against": against, "comparison_maps": True})):
            socket.send_json({**cursor, "serial": serial, "size": 41, "scene": False, **extra})
            headers = [header(socket.receive_bytes()) for _ in range(1 + len(extra) // 2)]
            assert [h["other"] for h in headers] == [True, False][-len(headers) :]
            assert {h["serial"] for h in headers} == {serial}
        other = {**cursor, "filter": "crossmodal-pf", "serial": 9, "size": 41, "scene": False}
        socket.send_json(other)
        assert header(socket.receive_bytes())["peak"] == headers[0]["peak"] != headers[1]["peak"]


def header(message: bytes) -> dict[str, Any]:
    size = int.from_bytes(message[:4], "little")
    values: dict[str, Any] = json.loads(message[4 : 4 + size])
    return values
