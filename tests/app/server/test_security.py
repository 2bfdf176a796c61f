"""The guard: who is let in, over HTTP and WebSockets alike, and what every answer carries."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Iterator
from dataclasses import replace

import pytest
from starlette.exceptions import HTTPException
from starlette.testclient import TestClient, WebSocketDenialResponse
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocketDisconnect

from beliefscope.app.server import security
from beliefscope.app.server.auth import Access
from beliefscope.app.runs.settings import Settings
from beliefscope.app.server.main import create_app
from beliefscope.app.server.security import MAX_BODY, Guard

JSON = {"content-type": "application/json"}


async def _nothing(*_: object) -> None:
    raise AssertionError("the guard's own rules do not call the application")


def scope(host: str, origin: str | None = None, method: str | None = "GET") -> Scope:
    headers = [(b"host", host.encode())] + ([] if origin is None else [(b"origin", origin.encode())])
    kind = {"type": "websocket"} if method is None else {"type": "http", "method": method}
    return kind | {"headers": headers, "path": "/"}


def problem(guard: Guard, asked: Scope) -> str:
    """Why it is not passed on; empty where it is."""
    reply = guard.reply(asked)
    return "" if reply is None else reply.reason


@pytest.mark.parametrize(
    "host", ["localhost", "localhost:8000", "LOCALHOST:1", "127.0.0.1:9", "[::1]:8000", "lab:8000"]
)
def test_a_known_name_at_any_port_may_read(host: str) -> None:
    assert problem(Guard(_nothing, ["lab"]), scope(host)) == ""


@pytest.mark.parametrize(
    "host",
    [
        *("evil.example", "evil.example:8000", "localhost.evil.example", "127.0.0.1.evil.example", "[::2]", "", "lab"),
        *("localhost.", "user@localhost", "localhost:80@evil.example", 'localhost:1"><script>', "localhost:x"),
        *("[::1]evil.example", "[::1]x:8000", "::1", "localhost, evil.example", "localhost evil.example", "127.1"),
    ],
)
def test_another_name_may_not_even_read(host: str) -> None:
    assert "is not answered here" in problem(Guard(_nothing), scope(host))


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", None])
@pytest.mark.parametrize(
    "origin",
    [None, "null", "http://evil.example", "http://localhost:8001", "http://localhost", "file://localhost:8000"],
)
def test_what_changes_something_comes_from_our_own_page(method: str | None, origin: str | None) -> None:
    guard = Guard(_nothing)
    assert "Origin" in problem(guard, scope("localhost:8000", origin, method))
    assert problem(guard, scope("localhost:8000", "http://localhost:8000", method)) == ""


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
@pytest.mark.parametrize("token", ["", "a-token-that-is-long-enough-for-one"])
def test_a_page_of_another_site_has_nothing_computed(site: str, token: str) -> None:
    """Reading needs no Origin, and what is read is made for it: runs of filters, for hours."""
    guard = Guard(_nothing, access=Access(token))
    script = [(b"authorization", f"Bearer {token}".encode())] * bool(token)

    def asked(site: str, mode: str, to: str) -> str:
        said = {"site": site, "mode": mode, "dest": to}
        headers = [(b"host", b"localhost"), *((f"sec-fetch-{n}".encode(), v.encode()) for n, v in said.items())]
        return problem(guard, scope("localhost") | {"headers": headers + script})

    for mode, to in (("no-cors", "image"), ("cors", "empty"), ("navigate", "iframe"), ("no-cors", "script")):
        assert "another site" in asked(site, mode, to)
        assert asked("same-origin", mode, to) == ""
    assert asked(site, "navigate", "document") == "", "a link leads here"
    assert asked("none", "navigate", "document") == "", "its user does"


def test_two_hosts_are_none() -> None:
    both = scope("localhost") | {"headers": [(b"host", b"localhost"), (b"host", b"evil.example")]}
    assert "one Host" in problem(Guard(_nothing), both)


def test_an_ipv6_name_is_known_by_its_brackets() -> None:
    assert problem(Guard(_nothing, ["fe80::1"]), scope("[fe80::1]:8000")) == ""


def test_a_refusal_says_why(client: TestClient) -> None:
    answer = client.get("/healthz", headers={"Host": "evil.example"})
    assert answer.status_code == 403
    assert answer.json()["error"].startswith("Host 'evil.example' is not answered here. Allowed: ")
    answer = client.post("/api/views", headers={"Origin": "http://evil.example"})
    assert answer.status_code == 403
    assert "http://evil.example" in answer.json()["error"]


@pytest.mark.parametrize("path", ["/api/views/{}", "/scene/{}"])
def test_sockets_are_guarded_too(client: TestClient, path: str) -> None:
    view = client.post("/api/views").json()["view"]
    for headers in ({"Origin": "http://evil.example"}, {"Host": "evil.example"}):
        with (
            pytest.raises(WebSocketDenialResponse) as refused,
            client.websocket_connect(path.format(view), headers=headers),
        ):
            pass
        assert refused.value.status_code == 403
        assert refused.value.json()["error"]


@pytest.mark.parametrize("path", ["/api/views/{}", "/scene/{}", "/api/live/{}"])
@pytest.mark.parametrize("name", ["x" * 3000, "%E2%82%AC" * 500])
def test_a_long_name_of_a_socket_is_told_as_far_as_it_fits(client: TestClient, path: str, name: str) -> None:
    with client.websocket_connect(path.format(name)) as socket:
        socket.send_json({"from": 0})
        with pytest.raises(WebSocketDisconnect) as closed:
            socket.receive_text()
    assert 4000 <= closed.value.code <= 4004
    assert 100 < len(closed.value.reason.encode()) <= 123


ALWAYS = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "origin-agent-cluster": "?1",
}


@pytest.mark.parametrize(
    "path", ["/", "/healthz", "/api/catalog", "/nowhere", "/api/trace/door/none/0", "/static/core/main.js"]
)
def test_every_answer_has_the_security_headers(client: TestClient, path: str) -> None:
    headers = client.get(path).headers
    assert {name: headers.get(name) for name in ALWAYS} == ALWAYS
    assert "camera=()" in headers["permissions-policy"]
    assert "microphone=()" in headers["permissions-policy"]
    assert "server" not in headers
    policy = headers["content-security-policy"]
    assert "http" not in policy, "nothing comes from other hosts"
    assert "'unsafe-eval'" not in policy


def test_a_refusal_has_them_too(client: TestClient) -> None:
    headers = client.get("/healthz", headers={"Host": "evil.example"}).headers
    assert {name: headers.get(name) for name in ALWAYS} == ALWAYS


def test_nobody_frames_the_page_and_only_the_page_the_scene(client: TestClient) -> None:
    scene = client.post("/api/views").json()["scene"]
    for path, ancestors, framed in (
        ("/", "'none'", "DENY"),
        ("/api/jobs", "'none'", "DENY"),
        (scene, "'self'", "SAMEORIGIN"),
    ):
        headers = client.get(path).headers
        assert f"frame-ancestors {ancestors};" in headers["content-security-policy"]
        assert headers["x-frame-options"] == framed


def test_only_the_scene_may_run_inline_scripts(client: TestClient) -> None:
    scene = client.post("/api/views").json()["scene"]
    assert "script-src 'self' 'unsafe-inline'" in client.get(scene).headers["content-security-policy"]
    assert "script-src 'self' 'wasm-unsafe-eval';" in client.get("/").headers["content-security-policy"]


def test_numbers_and_files_are_inert_as_pages(client: TestClient) -> None:
    for path in ("/api/catalog", "/static/icon.svg", "/vendor/rerun/viewer.js"):
        policy = client.get(path).headers["content-security-policy"]
        assert policy.startswith("default-src 'none';")
        assert policy.endswith("sandbox")


def test_a_body_is_no_larger_than_it_need_be(client: TestClient) -> None:
    def chunks() -> Iterator[bytes]:
        for _ in range(20):
            yield b" " * (MAX_BODY // 10)

    for body in (b" " * (MAX_BODY + 1), chunks()):
        answer = client.post("/api/recordings", content=body, headers={"content-type": "application/json"})
        assert answer.status_code == 413
        assert str(MAX_BODY) in answer.json()["error"]
    assert client.post("/api/views", content=b" " * 1000 + b'{"dark": true}', headers=JSON).status_code == 201


def test_a_body_that_never_ends_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(security, "PATIENCE", 0.01)

    async def body() -> dict[str, object]:
        await asyncio.sleep(10.0)
        return {}

    async def reads(scope: Scope, receive: Receive, send: Send) -> None:
        with pytest.raises(HTTPException) as error:
            await receive()
        assert error.value.status_code == 408

    sent: list[object] = []

    async def send(message: object) -> None:
        sent.append(message)

    asked = scope("localhost", "http://localhost", "POST")
    asyncio.run(Guard(reads)(asked, body, send))  # type: ignore[arg-type]
    assert not sent


def test_what_fails_is_told_with_a_mark_that_the_log_has_too(caplog: pytest.LogCaptureFixture) -> None:
    async def fails(scope: Scope, receive: Receive, send: Send) -> None:
        raise ZeroDivisionError("at the wrong moment")

    answer = TestClient(Guard(fails), base_url="http://localhost").get("/")
    assert answer.status_code == 500
    mark = re.fullmatch(r"at the wrong moment \(error ([0-9a-f]{8})\)", answer.json()["error"])
    assert mark
    assert answer.headers["x-content-type-options"] == "nosniff"
    (record,) = caplog.records
    assert record.event["error"] == mark[1]  # type: ignore[attr-defined]
    assert record.exc_info


def test_a_given_name_is_answered(settings: Settings) -> None:
    with TestClient(create_app(replace(settings, hosts=("lab",)), warm=False), base_url="http://lab:8000") as client:
        assert client.get("/healthz").json()["status"] == "ok"
