"""All kinds of filters and tasks on the server."""

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
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.simulation.push import PUSH
from beliefscope.datasets.store import write_dataset
from beliefscope.datasets.task import Task
from beliefscope.filters.batch import Steps
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import save_checkpoint

pytestmark = pytest.mark.slow

Serve = Callable[[Task, str], TestClient]


@pytest.fixture
def serve(tmp_path: Path, open_client: Callable[..., TestClient]) -> Iterator[Serve]:
    """Starts a server with one short episode of a task and one untrained filter."""
    opened: list[TestClient] = []

    def serve(task: Task, name: str) -> TestClient:
        simulate = (DOOR if task.map_components == DOOR.map_components else PUSH).simulate
        assert simulate is not None
        episode = simulate(0, 0, 20)
        observations = {key: episode.observations[key] for key in task.observations}
        episode = replace(episode, task=task, observations=observations)
        write_dataset(tmp_path / "episode.h5", task, [episode])
        filter_ = build(architecture(task, name))
        filter_.statistics.fit(Steps.from_episodes(task, [episode]))
        save_checkpoint(filter_, name, {}, tmp_path / name)
        data, checkpoints = {"data": tmp_path / "episode.h5"}, {"own": tmp_path / name}
        opened.append(open_client(Settings(tmp_path / "workspace", data, checkpoints, particles=30)))
        return opened[-1].__enter__()

    yield serve
    for client in opened:
        client.__exit__(None, None, None)


def header(client: TestClient, task: Task) -> dict[str, Any]:
    while (answer := client.get(f"/api/trace/{task.name}/own/0")).status_code == 202:
        pass
    assert answer.status_code == 200, answer.text
    values: dict[str, Any] = answer.json()
    return values


def map_layers(client: TestClient, task: Task) -> list[str] | None:
    """Send a cursor; the layers of the received maps, None if there are none. The scene is reply, too."""
    view = client.post("/api/views").json()
    cursor = {"serial": 1, "task": task.name, "filter": "own", "episode": 0, "step": 7, "size": 41, "data": "data"}
    with client.websocket_connect(view["socket"]) as socket:
        socket.send_json({"type": "cursor", **cursor})
        answer = socket.receive()
        reply = socket.receive_json()
    assert reply == {"type": "drawn", "serial": 1, "step": 7}
    if "bytes" not in answer:
        reply = json.loads(answer["text"])
        assert reply.pop("reason")
        assert reply == {"type": "no_maps", "serial": 1, "step": 7}
        return None
    length = int.from_bytes(answer["bytes"][:4], "little")
    layers: list[str] = json.loads(answer["bytes"][4 : 4 + length])["layers"]
    return layers


@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("name", "layers", "present", "absent"),
    [
        pytest.param(
            "feature-ekf",
            ["image+haptics", "fused"],
            "estimate_sigma",
            "weights effective_weights effective_sample_size",
            marks=pytest.mark.long,
        ),
        pytest.param(
            "image-pf",
            ["image", "fused"],
            "estimate_sigma effective_sample_size",
            "weights effective_weights",
            marks=pytest.mark.long,
        ),
        pytest.param(
            "unimodal-ekf", ["image", "haptics", "fused"], "effective_weights", "weights", marks=pytest.mark.long
        ),
        (
            "crossmodal-ukf",
            ["image", "haptics", "fused"],
            "effective_weights weights modality_sigma",
            "effective_sample_size",
        ),
        pytest.param(
            "information-ekf",
            ["image", "haptics", "fused"],
            "effective_weights weights",
            "effective_sample_size",
            marks=pytest.mark.long,
        ),
        pytest.param(
            "information-pf",
            ["image", "haptics", "fused"],
            "effective_weights weights effective_sample_size",
            "",
            marks=pytest.mark.long,
        ),
        ("lstm", None, "estimate_mean", "estimate_sigma modality_mean modality_sigma weights effective_weights"),
    ],
)
def test_columns_and_maps_of_a_filter(
    serve: Serve, name: str, layers: list[str] | None, present: str, absent: str
) -> None:
    client = serve(DOOR, name)
    values = header(client, DOOR)
    columns = {column["name"] for column in values["columns"]}
    assert {*present.split(), "truth", "estimate_mean"} <= columns
    assert not {*absent.split()} & columns
    assert values["modalities"] == (layers[:-1] if layers else [])
    assert (values["no_maps"] is None) == (layers is not None)
    assert map_layers(client, DOOR) == layers
    answer = client.post("/api/recordings", json={"task": "door", "filter": "own", "episode": 0})
    assert answer.status_code == 201, answer.text


PLAIN = replace(PUSH, name="plain", replay=None, outline=None)


def test_task_without_replay(serve: Serve) -> None:
    client = serve(PLAIN, "crossmodal-pf")
    assert [c["name"] for c in header(client, PLAIN)["components"]] == ["x", "y"]
    assert [(s["name"], s["height"], s["width"]) for s in header(client, PLAIN)["sensors"]] == [("image", 32, 32)]
    assert map_layers(client, PLAIN) == ["image", "haptics", "fused"]
    images = client.get(f"/api/trace/{PLAIN.name}/own/0/images").content
    assert len(images) == 20 * 32 * 32
    assert np.frombuffer(images, np.uint8).any()


def test_task_without_images(serve: Serve) -> None:
    task = replace(
        PUSH,
        name="no-images",
        observations={key: shape for key, shape in PUSH.observations.items() if len(shape) == 1},
        modalities={"haptics": PUSH.modalities["haptics"]},
    )
    client = serve(task, "haptics-ekf")
    assert header(client, task)["sensors"] == []
    assert map_layers(client, task) == ["haptics", "fused"]
    assert client.get(f"/api/trace/{task.name}/own/0/images").status_code == 404
