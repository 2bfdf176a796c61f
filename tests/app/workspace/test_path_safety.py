"""Names that come in requests and reach the disk: none leads out of the workspace, neither by itself nor by a link."""

from __future__ import annotations

import asyncio
import json
import re
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from urllib.parse import quote, unquote

import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient
from starlette.types import Message

from beliefscope.app.jobs.queue import Job
from beliefscope.app.server.main import Settings
from beliefscope.app.server.security import kept_file

SECRET = "what lies outside"
EVIL = (
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
    """The folder around the workspace, with files that nobody may have or touch."""
    folder = settings.workspace.parent
    for name in ("secret", "secret.rrd", "secret.html", "report.html", "result.json", "run.json", "job.json"):
        (folder / name).write_text(SECRET)
    (folder / "secret.py").write_text(f"open({str(folder / 'ran')!r}, 'w')")
    return folder


def asked(app: FastAPI, outside: Path) -> Iterator[tuple[str, str]]:
    """Method and path of every route that takes a name, each evil one in each place, what is there in the others."""
    there = {"task": "door", "filter": "crossmodal-ekf", "episode": "1", "act": "keep"}
    for path, methods in app.openapi()["paths"].items():
        for name in re.findall(r"\{(\w+)\}", path):
            for evil in EVIL:
                names = defaultdict(lambda: "x", there | {name: evil.format(outside=quote(str(outside)[1:], safe=""))})
                yield from ((method.upper(), path.format_map(names)) for method in methods)


def ask(client: TestClient, method: str, path: str, body: bytes) -> tuple[int, bytes]:
    """Status and body. Straight to the application: every HTTP client would put such a path right."""
    sent: list[Message] = []
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
        gone = asyncio.Event()
        parts = iter([{"type": "http.request", "body": body}])

        async def receive() -> Message:
            for part in parts:
                return part
            await gone.wait()
            return {"type": "http.disconnect"}

        async def send(message: Message) -> None:
            sent.append(message)

        await client.app(scope, receive, send)

    assert client.portal is not None
    client.portal.call(call)
    return sent[0]["status"], b"".join(part.get("body", b"") for part in sent[1:])


def test_no_name_leads_out_of_the_workspace(client: TestClient, outside: Path) -> None:
    before = {path: path.read_bytes() for path in outside.iterdir() if path.is_file()}
    count = 0
    for method, path in asked(client.app, outside):  # type: ignore[arg-type]
        status, told = ask(client, method, path, b"{}")
        assert 400 <= status < 500, (method, path)
        assert SECRET.encode() not in told
        count += 1
    assert count > 20 * len(EVIL)
    assert {path: path.read_bytes() for path in outside.iterdir() if path.is_file()} == before


@pytest.mark.parametrize("path", ["/static/{}", "/vendor/uplot/{}", "/{}"])
def test_nor_out_of_the_page(client: TestClient, outside: Path, path: str) -> None:
    for evil in (*EVIL, "../server.py", "..%2fserver.py", "%2e%2e/server.py", "../../app/server/main.py"):
        status, told = ask(client, "GET", path.format(evil.format(outside=quote(str(outside)[1:], safe=""))), b"")
        assert status == 404 or (status, path) == (200, "/{}"), evil
        assert b"create_app" not in told
        assert SECRET.encode() not in told


@pytest.mark.parametrize("key", ["faults", "data", "task", "filter"])
def test_nor_does_one_in_a_query_or_a_body(client: TestClient, outside: Path, key: str) -> None:
    run = {"task": "door", "filter": "crossmodal-ekf", "episode": 1}
    for name in (str(outside / "secret"), "../secret", f"{outside / 'secret.py'}:TASK", "../secret.py:TASK"):
        answers = [client.post("/api/recordings", json=run | {key: name})]
        for query in ({key: name}, {"against": f"{key}={name}"}):
            answers.append(client.get("/api/trace/door/crossmodal-ekf/1", params=query))
        for answer in answers[: 1 if key in ("task", "filter") else None]:
            assert 400 <= answer.status_code < 500, (key, name)
            assert SECRET not in answer.text
    assert not (outside / "ran").exists()


def test_a_link_out_of_the_workspace_is_not_followed(
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


def test_a_kept_file_lies_in_its_folder(tmp_path: Path) -> None:
    inside, outside = tmp_path / "inside", tmp_path / "secret"
    (inside / "deep").mkdir(parents=True)
    for path in (inside / "file", inside / "deep" / "file", outside):
        path.write_text("")
    (inside / "out").symlink_to(outside)
    (inside / "in").symlink_to("file")
    (inside / "circle").symlink_to("circle")
    for name in ("file", "deep/file", "in", "deep/../file"):
        assert kept_file(inside, name) is not None
    for name in ("", "deep", "missing", "out", "circle", "../secret", str(outside), "file\0", "x" * 5000):
        assert kept_file(inside, name) is None
    (tmp_path / "moved").symlink_to(inside)
    assert kept_file(tmp_path / "moved", "file") == inside / "file", "the folder itself may lie elsewhere"
