"""The command ``serve`` as a process: output, files, logs, and shutdown."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from starlette.types import Receive, Scope, Send

from beliefscope.app.cli.commands.serve import Served, _browser_opener
from beliefscope.app.jobs.queue import Jobs
from beliefscope.app.runs.settings import Settings
from beliefscope.app.server import timeouts
from beliefscope.app.server.main import create_app
from beliefscope.app.server.timeouts import HTTPProtocol
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path, write_dataset
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter

pytestmark = pytest.mark.slow

TIMEOUT = 60.0  # s


@contextlib.contextmanager
def served(workspace: Path, *options: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Yields a server process and its address."""
    command = [sys.executable, "-m", "beliefscope", "serve", "--port", "0", "--workspace", str(workspace), *options]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        line = server.stdout.readline()
        address = re.search(r"http://127\.0\.0\.1:\d+", line)
        assert address, line
        yield server, address.group()
    finally:
        server.kill()
        server.communicate()


def request_json(url: str, body: Any = None) -> Any:
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(
        url, data, {"content-type": "application/json", "origin": url[: url.index("/", 8)]}
    )
    with urllib.request.urlopen(request, timeout=TIMEOUT) as answer:
        return json.load(answer)


@pytest.mark.long
def test_sigterm_saves_jobs_and_is_logged(tmp_path: Path) -> None:
    workspace = tmp_path / "workspace"
    with served(workspace, "--log-level", "info", "--log-format", "json") as (server, address):
        assert request_json(f"{address}/healthz")["status"] == "ok"
        request_json(f"{address}/api/finetune/push/crossmodal-ekf", {"train": ["haptics-only"], "steps": 20000})
        end = time.monotonic() + TIMEOUT
        while request_json(f"{address}/api/jobs")[0]["state"] != "running":
            assert time.monotonic() < end
        server.send_signal(signal.SIGTERM)
        _, errors = server.communicate(timeout=TIMEOUT)
        assert server.returncode == 0, errors
    lines = [json.loads(line) for line in errors.splitlines()]
    assert [line["event"] for line in lines] == ["started", "job started", "job ended", "stopped"]
    assert lines[0]["url"].startswith(address)
    assert lines[2]["state"] == "interrupted"
    (job,) = Jobs(workspace / "jobs").all()
    assert (job.state, job.error) == ("interrupted", "the server stopped")


@pytest.mark.long
def test_other_signals_end_the_jobs(tmp_path: Path) -> None:
    """A closed terminal, and Ctrl-C again and again, after which uvicorn would leave out what ends the jobs."""
    workspace = tmp_path / "workspace"
    with served(workspace) as (server, address):
        request_json(f"{address}/api/finetune/push/crossmodal-ekf", {"train": ["haptics-only"], "steps": 20000})
        end = time.monotonic() + TIMEOUT / 2
        while server.poll() is None and time.monotonic() < end:
            server.send_signal(signal.SIGHUP)
            server.send_signal(signal.SIGINT)
            time.sleep(0.02)
        assert server.poll() == 0
        assert server.communicate() == ("", "")
    (job,) = (json.loads(path.read_text()) for path in workspace.glob("jobs/*/job.json"))
    assert (job["state"], job["error"]) == ("interrupted", "the server stopped")


def test_filters_keep_their_order(tmp_path: Path) -> None:
    """The page opens the first one, whether it is a file or code."""
    code = "examples/04_own_filter.py:build"
    texts = [str(tmp_path / "b.safetensors"), code, str(tmp_path / "a.safetensors")]
    filters = Served(task=[], data=[], filter=texts).settings(tmp_path).checkpoints
    assert [type(source).__name__ for source in filters.values()] == ["PosixPath", "ExternalFilter", "PosixPath"]
    assert [name for name in filters if len(name) == 1] == ["b", "a"]


OWN = """
def build(): return lambda *, observations, controls: controls[..., :2]
def named():
    def still(*, observations, controls): return controls[..., :2]
    still.task = "own"
    return still
"""


def test_data_define_the_task_of_filters(tmp_path: Path) -> None:
    """As for all other commands: the name is enough where the data contain the definition."""
    with open_dataset(sample_path("push")) as sample:
        own = replace(sample.task, name="own")
        write_dataset(tmp_path / "own.h5", own, [replace(sample[0], task=own)])
    code = tmp_path / "own_filters.py"
    code.write_text(OWN)

    def filters(function: str, tasks: list[str]) -> Iterable[Path | Checkpoint]:
        served = Served(task=tasks, data=[tmp_path / "own.h5"], filter=[f"{code}:{function}"])
        return served.settings(tmp_path).checkpoints.values()

    for function in ("build", "named"):
        for tasks in ([], ["own"]):
            (external,) = filters(function, tasks)
            assert isinstance(external, ExternalFilter)
            assert external.task.name == "own"
    (external,) = filters("named", ["push"])
    assert isinstance(external, ExternalFilter)
    assert external.task.name == "own"
    with pytest.raises(BadInput, match="task 'other' does not exist"):
        filters("build", ["other"])


def test_workspace_that_cannot_be_created(settings: Settings) -> None:
    with pytest.raises(BadInput, match="workspace '/proc/none' cannot be created: No such file or directory"):
        create_app(replace(settings, workspace=Path("/proc/none")), warm=False)


def test_workspace_is_private(settings: Settings) -> None:
    create_app(settings, warm=False)
    assert stat.S_IMODE(settings.workspace.stat().st_mode) == 0o700


def test_token_is_passed_to_the_browser_in_a_private_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    link = "http://lab:8000/?token=secret"
    with _browser_opener(tmp_path, secret=True) as open_in_browser:
        open_in_browser(link)
        (page,) = tmp_path.iterdir()
        assert opened == [page.as_uri()], "other users can see the browser's command line"
        assert stat.S_IMODE(page.stat().st_mode) == 0o600
        assert link in page.read_text()
    assert not list(tmp_path.iterdir())
    with _browser_opener(tmp_path, secret=False) as open_in_browser:
        open_in_browser("http://127.0.0.1:8000/")
    assert opened[1:] == ["http://127.0.0.1:8000/"]


async def _respond(scope: Scope, receive: Receive, send: Send) -> None:
    assert scope["type"] == "http"
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"3")]})
    await send({"type": "http.response.body", "body": b"yes"})


@pytest.fixture
def server_address(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, int]]:
    """Address of a server with a header timeout of half a second."""
    monkeypatch.setattr(timeouts, "HEAD_TIMEOUT", 0.5)
    config = uvicorn.Config(_respond, port=0, log_level="error", http=HTTPProtocol, lifespan="off")
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    yield server.servers[0].sockets[0].getsockname()
    server.should_exit = True
    thread.join(10.0)


REQUEST = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"


def read_response(connection: socket.socket) -> None:
    response = b""
    while not response.endswith(b"yes"):
        part = connection.recv(4096)
        assert part
        response += part


@pytest.mark.parametrize("before", [b"", REQUEST], ids=["first request", "second request"])
@pytest.mark.parametrize("part", [b"GET / HTTP/1.1\r\nX: y", b""], ids=["partial header", "no data"])
def test_incomplete_header_times_out(server_address: tuple[str, int], before: bytes, part: bytes) -> None:
    with socket.create_connection(server_address, timeout=10.0) as slow:
        if before:
            slow.sendall(before)
            read_response(slow)
        slow.sendall(part)
        started = time.monotonic()
        if part:
            with contextlib.suppress(OSError):  # closed during a write
                for _ in range(100):
                    slow.sendall(b"y")
                    slow.settimeout(0.1)
                    with contextlib.suppress(TimeoutError):
                        if not slow.recv(1):
                            break
        elif not before:  # between requests, uvicorn's keep-alive timeout of 5 s applies
            assert slow.recv(1) == b""
        assert time.monotonic() - started < 5.0


def test_fast_requests_keep_the_connection(server_address: tuple[str, int]) -> None:
    with socket.create_connection(server_address, timeout=10.0) as quick:
        for _ in range(5):
            quick.sendall(REQUEST)
            read_response(quick)
            time.sleep(0.2)
