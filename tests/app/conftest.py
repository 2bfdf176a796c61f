"""A small data set, two untrained filters, and servers that show them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from starlette.testclient import TestClient, WebSocketTestSession

from beliefscope.app.server.main import Settings, create_app
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import write_dataset
from beliefscope.filters.batch import Steps
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import save_checkpoint

ORIGIN = "http://localhost:8000"
FILTERS = ("crossmodal-ekf", "crossmodal-pf")


@pytest.fixture(scope="session")
def steps() -> int:
    """Of each episode."""
    return 40


@pytest.fixture(scope="session")
def given(tmp_path_factory: pytest.TempPathFactory, steps: int) -> Settings:
    """What the servers are given; its workspace is to be replaced by each test's own."""
    folder = tmp_path_factory.mktemp("given")
    simulate = DOOR.simulate
    assert simulate is not None
    episodes = [replace(simulate(0, index, steps), split=split) for index, split in enumerate(("train", "test"))]
    write_dataset(folder / "door.h5", DOOR, episodes)
    for name in FILTERS:
        filter_ = build(architecture("door", name))
        filter_.statistics.fit(Steps.of(DOOR, episodes))
        save_checkpoint(filter_, name, {"command": "none", "metrics": {"position_cm": 1.5}}, folder / name)
    checkpoints = {name: folder / name for name in FILTERS}
    return Settings(folder, data={"mine": folder / "door.h5"}, checkpoints=checkpoints, particles=30)


@pytest.fixture
def settings(given: Settings, tmp_path: Path) -> Settings:
    return replace(given, workspace=tmp_path / "workspace")


class Browser(TestClient):
    """The application without a network, asked by its own page."""

    def __init__(self, settings: Settings, warm: bool = False) -> None:
        super().__init__(create_app(settings, warm), base_url=ORIGIN, headers={"Origin": ORIGIN})

    def websocket_connect(self, url: str, *args: Any, **kwargs: Any) -> WebSocketTestSession:
        # Starlette's own takes no notice of the base address.
        return super().websocket_connect(f"ws://{self.base_url.netloc.decode()}{url}", *args, **kwargs)


@pytest.fixture
def open_client() -> Callable[..., TestClient]:
    return Browser


@pytest.fixture
def client(settings: Settings) -> Iterator[TestClient]:
    with Browser(settings) as client:
        yield client


@pytest.fixture
def address(settings: Settings) -> Iterator[str]:
    """``localhost:port`` of a real server in a thread."""
    config = uvicorn.Config(create_app(settings, warm=False), port=0, log_level="error", ws_per_message_deflate=False)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.01)
        assert thread.is_alive()
    yield f"localhost:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join(10.0)
    assert not thread.is_alive()


@pytest.fixture
def traced(client: TestClient) -> str:
    """Address of a trace that has been computed."""
    url = "/api/trace/door/crossmodal-pf/1"
    deadline = time.monotonic() + 30.0
    while (answer := client.get(url)).status_code == 202:
        assert 0.0 <= answer.json()["progress"] <= 1.0
        assert time.monotonic() < deadline
    assert answer.status_code == 200, answer.text
    return url
