"""A live run whose filter lost the state at one step: the other steps have maps, this one the reason."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from starlette.testclient import TestClient

import beliefscope as bs
from beliefscope.app.runs.settings import Settings

pytestmark = pytest.mark.slow

TASK = bs.Task(
    name="crane",
    components=(bs.Component("cart", "m"), bs.Component("swing", "rad")),
    observations={"encoder": (1,)},
    modalities={"encoder": ("encoder",)},
    control_size=0,
    dt=0.1,
    map_components=("cart", "swing"),
    map_half_width=0.2,
)
LOST = 2


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    values = [*np.full(LOST, 0.01), np.nan, 0.01]
    with bs.LiveRecorder("run", task=TASK, folder=tmp_path / "workspace" / "live", filter="own", views=False) as live:
        for value in values:
            estimate = {"estimate_mean": np.full(2, value), "estimate_covariance": np.eye(2) * 1e-4}
            live.step(estimate, {"encoder": np.zeros(1)}, np.zeros(0), truth=np.zeros(2))
    return Settings(tmp_path / "workspace")


def test_one_step_without_an_estimate_does_not_stop_the_maps(client: TestClient) -> None:
    view = client.post("/api/views", json={}).json()
    cursor = {"task": "crane", "filter": "own", "episode": 0, "size": 41, "data": "live:run", "scene": False}
    with client.websocket_connect(view["socket"]) as socket:
        for step in (LOST - 1, LOST, LOST + 1):
            socket.send_json({"type": "cursor", "serial": step, "step": step, **cursor})
            answer = socket.receive()
            if step == LOST:
                reply = json.loads(answer["text"])
                assert (reply["type"], reply["step"]) == ("no_maps", step)
                assert reply["reason"] == f"No maps: the estimate at step {step} is not a finite number."
            else:
                assert answer.get("bytes"), answer
