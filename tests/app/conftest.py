"""Fixtures: a small data set, two untrained filters, and servers that offer them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from fastapi.routing import APIRoute
from pydantic import TypeAdapter
from starlette.testclient import TestClient, WebSocketTestSession

from beliefscope.app.api.models import Error
from beliefscope.app.runs.settings import Settings
from beliefscope.app.server.main import create_app
from beliefscope.datasets.simulation.door import DOOR
from beliefscope.datasets.store import write_dataset
from beliefscope.filters.batch import Steps
from beliefscope.filters.catalog import architecture, build
from beliefscope.filters.checkpoint import save_checkpoint

ORIGIN = "http://localhost:8000"
FILTERS = ("crossmodal-ekf", "crossmodal-pf")


@pytest.fixture(scope="session")
def steps() -> int:
    """Number of steps of each episode."""
    return 40


@pytest.fixture(scope="session")
def base_settings(tmp_path_factory: pytest.TempPathFactory, steps: int) -> Settings:
    """Settings shared by all tests; each test replaces the workspace."""
    folder = tmp_path_factory.mktemp("inputs")
    simulate = DOOR.simulate
    assert simulate is not None
    episodes = [replace(simulate(0, index, steps), split=split) for index, split in enumerate(("train", "test"))]
    write_dataset(folder / "door.h5", DOOR, episodes)
    for name in FILTERS:
        filter_ = build(architecture("door", name))
        filter_.statistics.fit(Steps.from_episodes(DOOR, episodes))
        save_checkpoint(filter_, name, {"command": "none", "metrics": {"position_cm": 1.5}}, folder / name)
    checkpoints = {name: folder / name for name in FILTERS}
    return Settings(folder, data={"mine": folder / "door.h5"}, checkpoints=checkpoints, particles=30)


@pytest.fixture
def settings(base_settings: Settings, tmp_path: Path) -> Settings:
    return replace(base_settings, workspace=tmp_path / "workspace")


@cache
def _adapter(model: Any) -> TypeAdapter[Any]:
    """Kept, as creating one takes milliseconds."""
    return TypeAdapter(model)


def check_response(app: Any, method: str, response: Any) -> None:
    """Validate a JSON response against the model that its route declares."""
    if not response.headers.get("content-type", "").startswith("application/json"):
        return
    for route in app.routes:
        if isinstance(route, APIRoute) and method in route.methods and route.path_regex.match(response.url.path):
            declared = {str(status): answer.get("model") for status, answer in route.responses.items()}
            model = Error if response.is_error else declared.get(str(response.status_code), route.response_model)
            if model is not None:
                _adapter(model).validate_json(response.content, strict=True, extra="forbid")
            return


class Browser(TestClient):
    """Test client that sends the Origin header of the server's own page."""

    def __init__(self, settings: Settings, warm: bool = False) -> None:
        super().__init__(create_app(settings, warm), base_url=ORIGIN, headers={"Origin": ORIGIN})

    def request(self, method: str, url: Any, *args: Any, **kwargs: Any) -> Any:
        response = super().request(method, url, *args, **kwargs)
        check_response(self.app, method, response)
        return response

    def websocket_connect(self, url: str, *args: Any, **kwargs: Any) -> WebSocketTestSession:
        # Starlette's implementation ignores the base URL.
        return super().websocket_connect(f"ws://{self.base_url.netloc.decode()}{url}", *args, **kwargs)


@pytest.fixture(scope="session")
def open_client() -> Callable[..., TestClient]:
    return Browser


@pytest.fixture
def client(settings: Settings) -> Iterator[TestClient]:
    with Browser(settings) as client:
        yield client


@pytest.fixture(scope="module")
def shared_client(base_settings: Settings, tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """Client of a server for all tests of a module that do not depend on the contents of its workspace."""
    with Browser(replace(base_settings, workspace=tmp_path_factory.mktemp("workspace"))) as client:
        yield client


@pytest.fixture
def address(settings: Settings) -> Iterator[str]:
    """``localhost:port`` of a server in a thread."""
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


def compute_trace(client: TestClient) -> str:
    """URL of a trace that has been computed."""
    url = "/api/trace/door/crossmodal-pf/1"
    deadline = time.monotonic() + 30.0
    while (response := client.get(url)).status_code == 202:
        assert 0.0 <= response.json()["progress"] <= 1.0
        assert time.monotonic() < deadline
    assert response.status_code == 200, response.text
    return url


@pytest.fixture
def trace_url(client: TestClient) -> str:
    """URL of a trace that has been computed."""
    return compute_trace(client)


@pytest.fixture(scope="module")
def shared_trace_url(shared_client: TestClient) -> str:
    """URL of a trace on the shared server."""
    return compute_trace(shared_client)
