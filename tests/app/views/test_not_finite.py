"""A live run whose filter lost the state or its covariance at one step: it has the reason, the others have maps."""

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
LOST, INDEFINITE = 2, 3


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    steps = [(0.01, 1e-4), (0.01, 1e-4), (np.nan, 1e-4), (0.01, -1e-4), (0.01, 1e-4)]
    with bs.LiveRecorder("run", task=TASK, folder=tmp_path / "workspace" / "live", filter="own", views=False) as live:
        for value, variance in steps:
            estimate = {"estimate_mean": np.full(2, value), "estimate_covariance": np.eye(2) * variance}
            live.step(estimate, {"encoder": np.zeros(1)}, np.zeros(0), truth=np.zeros(2))
    return Settings(tmp_path / "workspace")


def test_one_step_without_a_belief_does_not_stop_the_maps(client: TestClient) -> None:
    view = client.post("/api/views", json={}).json()
    cursor = {"task": "crane", "filter": "own", "episode": 0, "size": 41, "data": "live:run", "scene": False}
    with client.websocket_connect(view["socket"]) as socket:
        for step in range(1, 5):
            socket.send_json({"type": "cursor", "serial": step, "step": step, **cursor})
            answer = socket.receive()
            if step in (LOST, INDEFINITE):
                reply = json.loads(answer["text"])
                assert (reply["type"], reply["step"]) == ("no_maps", step)
                reason = "the estimate at step 2 is not a finite number"
                assert reason in reply["reason"] if step == LOST else "a covariance at step 3 is not" in reply["reason"]
            else:
                assert answer.get("bytes"), answer
