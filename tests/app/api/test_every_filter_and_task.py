"""Every kind of filter and of task on the server: what it has is there, and what it has not is said."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from beliefscope.app.runs.settings import Settings
from beliefscope.datasets.catalog import TASKS
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.simulation.push import PUSH
from beliefscope.datasets.store import write_dataset
from beliefscope.datasets.task import Task
from beliefscope.filters.batch import Steps
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import save_checkpoint

Serve = Callable[[Task, str], TestClient]


@pytest.fixture
def serve(tmp_path: Path, open_client: Callable[..., TestClient]) -> Iterator[Serve]:
    """A server of one short episode of a task and one untrained filter, which is named."""
    opened: list[TestClient] = []

    def serve(task: Task, name: str) -> TestClient:
        simulate = (DOOR if task.map_components == DOOR.map_components else PUSH).simulate
        assert simulate is not None
        episode = simulate(0, 0, 20)
        seen = {key: episode.observations[key] for key in task.observations}
        episode = replace(episode, task=task.name, observations=seen)
        write_dataset(tmp_path / "one.h5", task, [episode])
        filter_ = build(architecture(task.name, name))
        filter_.statistics.fit(Steps.from_episodes(task, [episode]))
        save_checkpoint(filter_, name, {}, tmp_path / name)
        data, checkpoints = {"one": tmp_path / "one.h5"}, {"own": tmp_path / name}
        opened.append(open_client(Settings(tmp_path / "workspace", data, checkpoints, particles=30)))
        return opened[-1].__enter__()

    yield serve
    for client in opened:
        client.__exit__(None, None, None)


def header(client: TestClient, task: Task) -> dict[str, Any]:
    while (answer := client.get(f"/api/trace/{task.name}/own/0")).status_code == 202:
        pass
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = answer.json()
    return found


def look(client: TestClient, task: Task) -> list[str] | None:
    """Moves a page's cursor to a step; the layers of the maps that come, None where none do. The scene is drawn."""
    view = client.post("/api/views").json()
    cursor = {"serial": 1, "task": task.name, "filter": "own", "episode": 0, "step": 7, "size": 41, "data": "one"}
    with client.websocket_connect(view["socket"]) as socket:
        socket.send_json({"type": "cursor", **cursor})
        answer = socket.receive()
        drawn = socket.receive_json()
    assert drawn == {"type": "drawn", "serial": 1, "step": 7}
    if "bytes" not in answer:
        assert json.loads(answer["text"]) == {"type": "no_maps", "serial": 1, "step": 7}
        return None
    length = int.from_bytes(answer["bytes"][:4], "little")
    layers: list[str] = json.loads(answer["bytes"][4 : 4 + length])["layers"]
    return layers


@pytest.mark.parametrize(
    ("name", "layers", "has", "has_not"),
    [
        ("feature-ekf", ["image+haptics", "fused"], "estimate_sigma", "weights effective_weights effective_sample_size"),
        ("image-pf", ["image", "fused"], "estimate_sigma effective_sample_size", "weights effective_weights"),
        ("unimodal-ekf", ["image", "haptics", "fused"], "effective_weights", "weights"),
        ("crossmodal-ukf", ["image", "haptics", "fused"], "effective_weights weights modality_sigma", "effective_sample_size"),
        ("lstm", None, "estimate_mean", "estimate_sigma modality_mean modality_sigma weights effective_weights"),
    ],
)
def test_a_filter_shows_what_it_has(serve: Serve, name: str, layers: list[str] | None, has: str, has_not: str) -> None:
    client = serve(DOOR, name)
    found = header(client, DOOR)
    columns = {column["name"] for column in found["columns"]}
    assert {*has.split(), "truth", "estimate_mean"} <= columns
    assert not {*has_not.split()} & columns
    assert found["modalities"] == (layers[:-1] if layers else [])
    assert (found["no_maps"] is None) == (layers is not None)
    assert look(client, DOOR) == layers
    answer = client.post("/api/recordings", json={"task": "door", "filter": "own", "episode": 0})
    assert answer.status_code == 201, answer.text


PLAIN = replace(PUSH, name="plain", replay=None, outline=None)


def test_a_task_without_a_replay_has_a_scene(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(TASKS, PLAIN.name, PLAIN)
    client = serve(PLAIN, "crossmodal-pf")
    assert [c["name"] for c in header(client, PLAIN)["components"]] == ["x", "y"]
    assert header(client, PLAIN)["pictures"] == [32, 32]
    assert look(client, PLAIN) == ["image", "haptics", "fused"]
    images = client.get(f"/api/trace/{PLAIN.name}/own/0/images").content
    assert len(images) == 20 * 32 * 32
    assert np.frombuffer(images, np.uint8).any()


def test_a_task_without_pictures_has_none(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    blind = replace(
        PUSH,
        name="blind",
        observations={key: shape for key, shape in PUSH.observations.items() if len(shape) == 1},
        modalities={"haptics": PUSH.modalities["haptics"]},
    )
    monkeypatch.setitem(TASKS, blind.name, blind)
    client = serve(blind, "haptics-ekf")
    assert header(client, blind)["pictures"] is None
    assert look(client, blind) == ["haptics", "fused"]
    assert client.get(f"/api/trace/{blind.name}/own/0/images").status_code == 404
