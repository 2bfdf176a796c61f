"""File names in requests: none leads out of the workspace, neither directly nor through a link."""

from __future__ import annotations

import asyncio
import json
import re
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from urllib.parse import quote, unquote

import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient
from starlette.types import Message

from beliefscope.app.jobs.queue import Job
from beliefscope.app.runs.settings import Settings
from beliefscope.app.workspace.paths import file_within

pytestmark = pytest.mark.slow

SECRET = "outside the workspace"
UNSAFE_NAMES = (
    "..",
    ".",
    "../secret",
    "..%2fsecret",
    "%2e%2e%2fsecret",
    "..%252fsecret",
    "..\\secret",
    "....//secret",
    "/{outside}/secret",
    "%2f{outside}%2fsecret",
    "//{outside}/secret",
    "secret%00",
    "%00",
    "secret%0a",
    "~",
    ".secret",
    "-rf",
    "file:%2f%2f{outside}%2fsecret",
    "{outside}%2fsecret.py:TASK",
    "x" * 300,
    "%e2%80%ae",
    "%ff%fe",
)


@pytest.fixture
def outside(settings: Settings) -> Path:
    """The folder around the workspace, with files that must not be read or changed."""
    folder = settings.workspace.parent
    for name in ("secret", "secret.rrd", "secret.html", "report.html", "result.json", "run.json", "job.json"):
        (folder / name).write_text(SECRET)
    (folder / "secret.py").write_text(f"open({str(folder / 'ran')!r}, 'w')")
    return folder


def requests(app: FastAPI, outside: Path) -> Iterator[tuple[str, str]]:
    """Method and path of every route with a name: each unsafe name in each parameter, valid values in the others."""
    valid = {"task": "door", "filter": "crossmodal-ekf", "episode": "1", "act": "keep"}
    for path, methods in app.openapi()["paths"].items():
        for name in re.findall(r"\{(\w+)\}", path):
            for unsafe in UNSAFE_NAMES:
                names = defaultdict(
                    lambda: "x", valid | {name: unsafe.format(outside=quote(str(outside)[1:], safe=""))}
                )
                yield from ((method.upper(), path.format_map(names)) for method in methods)


def send(client: TestClient, method: str, path: str, body: bytes) -> tuple[int, bytes]:
    """Status and body. Calls the application directly, because HTTP clients normalize paths."""
    messages: list[Message] = []
    headers = {"host": "localhost:8000", "origin": "http://localhost:8000", "content-type": "application/json"}
    scope = {
        "type": "http",
        "method": method,
        "path": unquote(path),
        "raw_path": path.encode(),
        "root_path": "",
        "scheme": "http",
        "query_string": b"",
        "headers": [(name.encode(), value.encode()) for name, value in headers.items()],
    }

    async def call() -> None:
        disconnected = asyncio.Event()
        parts = iter([{"type": "http.request", "body": body}])

        async def receive() -> Message:
            for part in parts:
                return part
            await disconnected.wait()
            return {"type": "http.disconnect"}

        async def collect(message: Message) -> None:
            messages.append(message)

        await client.app(scope, receive, collect)

    assert client.portal is not None
    client.portal.call(call)
    return messages[0]["status"], b"".join(part.get("body", b"") for part in messages[1:])


def test_path_parameters_stay_in_the_workspace(client: TestClient, outside: Path) -> None:
    before = {path: path.read_bytes() for path in outside.iterdir() if path.is_file()}
    count = 0
    for method, path in requests(client.app, outside):  # type: ignore[arg-type]
        status, body = send(client, method, path, b"{}")
        assert 400 <= status < 500, (method, path)
        assert SECRET.encode() not in body
        count += 1
    assert count > 20 * len(UNSAFE_NAMES)
    assert {path: path.read_bytes() for path in outside.iterdir() if path.is_file()} == before


def test_static_files_stay_in_the_page_folder(client: TestClient, outside: Path) -> None:
    others = ("../server.py", "..%2fserver.py", "%2e%2e/server.py", "../../app/server/main.py")
    for path, unsafe in product(("/static/{}", "/vendor/uplot/{}", "/{}"), (*UNSAFE_NAMES, *others)):
        status, body = send(client, "GET", path.format(unsafe.format(outside=quote(str(outside)[1:], safe=""))), b"")
        assert status == 404 or (status, path) == (200, "/{}"), unsafe
        assert b"create_app" not in body
        assert SECRET.encode() not in body


def test_queries_and_bodies_stay_in_the_workspace(client: TestClient, outside: Path) -> None:
    run = {"task": "door", "filter": "crossmodal-ekf", "episode": 1}
    names = (str(outside / "secret"), "../secret", f"{outside / 'secret.py'}:TASK", "../secret.py:TASK")
    for key, name in product(("faults", "data", "task", "filter"), names):
        answers = [client.post("/api/recordings", json=run | {key: name})]
        for query in ({key: name}, {"against": f"{key}={name}"}):
            answers.append(client.get("/api/trace/door/crossmodal-ekf/1", params=query))
        for answer in answers[: 1 if key in ("task", "filter") else None]:
            assert 400 <= answer.status_code < 500, (key, name)
            assert SECRET not in answer.text
    assert not (outside / "ran").exists()


def test_links_out_of_the_workspace_are_not_followed(
    settings: Settings, outside: Path, open_client: Callable[..., TestClient]
) -> None:
    workspace, name = settings.workspace, "door-crossmodal-ekf-episode1-0123abcd"
    job = replace(Job("0123456789abcdef", "report", "a report"), state="done", progress=1.0)
    for folder in ("recordings", f"reports/{name}", "jobs", f"jobs/{job.id}", "finetune", "live"):
        (workspace / folder).mkdir(parents=True)
    (workspace / "recordings" / f"{name}.rrd").symlink_to(outside / "secret.rrd")
    (workspace / "live" / "run.rrd").symlink_to(outside / "secret.rrd")
    (workspace / f"reports/{name}/report.html").symlink_to(outside / "secret.html")
    (workspace / "reports" / name.replace("1-", "2-")).symlink_to(outside, target_is_directory=True)
    (workspace / f"jobs/{job.id}/job.json").write_text(json.dumps(asdict(job)))
    (workspace / f"jobs/{job.id}/result.json").symlink_to(outside / "result.json")
    (workspace / "finetune" / "0123").symlink_to(outside, target_is_directory=True)
    with open_client(settings) as client:
        for path in (
            f"/api/recordings/{name}.rrd",
            "/api/live/run.rrd",
            f"/api/reports/{name}.html",
            f"/api/reports/{name.replace('1-', '2-')}.html",
            f"/api/jobs/{job.id}/result",
            "/api/tuned/0123",
            "/api/tuned/..",
        ):
            answer = client.get(path)
            assert 400 <= answer.status_code < 500, path
            assert SECRET not in answer.text
        client.delete(f"/api/recordings/{name}.rrd")
        client.delete(f"/api/jobs/{job.id}")
    assert (outside / "secret.rrd").read_text() == SECRET
    assert (outside / "result.json").read_text() == SECRET


def test_file_within_rejects_paths_outside_the_folder(tmp_path: Path) -> None:
    inside, outside = tmp_path / "inside", tmp_path / "secret"
    (inside / "deep").mkdir(parents=True)
    for path in (inside / "file", inside / "deep" / "file", outside):
        path.write_text("")
    (inside / "out").symlink_to(outside)
    (inside / "in").symlink_to("file")
    (inside / "circle").symlink_to("circle")
    for name in ("file", "deep/file", "in", "deep/../file"):
        assert file_within(inside, name) is not None
    for name in ("", "deep", "missing", "out", "circle", "../secret", str(outside), "file\0", "x" * 5000):
        assert file_within(inside, name) is None
    (tmp_path / "moved").symlink_to(inside)
    assert file_within(tmp_path / "moved", "file") == inside / "file", "the folder itself may be a link"
