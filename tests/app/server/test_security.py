"""Access control and security headers of HTTP requests and WebSockets."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import Iterator
from dataclasses import replace

import pytest
from starlette.exceptions import HTTPException
from starlette.testclient import TestClient, WebSocketDenialResponse
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocketDisconnect

from beliefscope.app.runs.settings import Settings
from beliefscope.app.server import security
from beliefscope.app.server.auth import Access
from beliefscope.app.server.main import create_app
from beliefscope.app.server.security import MAX_BODY, Guard

pytestmark = pytest.mark.slow

JSON = {"content-type": "application/json"}


async def _nothing(*_: object) -> None:
    raise AssertionError("the application must not be called")


def scope(host: str, origin: str | None = None, method: str | None = "GET") -> Scope:
    headers = [(b"host", host.encode())] + ([] if origin is None else [(b"origin", origin.encode())])
    kind = {"type": "websocket"} if method is None else {"type": "http", "method": method}
    return kind | {"headers": headers, "path": "/"}


def refusal(guard: Guard, request: Scope) -> str:
    """The reason of a refusal, or empty."""
    reply = guard.reply(request)
    return "" if reply is None else json.loads(reply.body)["error"]


@pytest.mark.parametrize(
    "host", ["localhost", "localhost:8000", "LOCALHOST:1", "127.0.0.1:9", "[::1]:8000", "lab:8000"]
)
def test_known_hosts_with_any_port_are_allowed(host: str) -> None:
    assert refusal(Guard(_nothing, ["lab"]), scope(host)) == ""


@pytest.mark.parametrize(
    "host",
    [
        *("evil.example", "evil.example:8000", "localhost.evil.example", "127.0.0.1.evil.example", "[::2]", "", "lab"),
        *("localhost.", "user@localhost", "localhost:80@evil.example", 'localhost:1"><script>', "localhost:x"),
        *("[::1]evil.example", "[::1]x:8000", "::1", "localhost, evil.example", "localhost evil.example", "127.1"),
    ],
)
def test_unknown_hosts_are_refused(host: str) -> None:
    assert "is not allowed" in refusal(Guard(_nothing), scope(host))


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", None])
@pytest.mark.parametrize(
    "origin",
    [None, "null", "http://evil.example", "http://localhost:8001", "http://localhost", "file://localhost:8000"],
)
def test_changes_require_own_origin(method: str | None, origin: str | None) -> None:
    guard = Guard(_nothing)
    assert "Origin" in refusal(guard, scope("localhost:8000", origin, method))
    assert refusal(guard, scope("localhost:8000", "http://localhost:8000", method)) == ""


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
@pytest.mark.parametrize("token", ["", "a-token-that-is-long-enough-for-one"])
def test_cross_site_requests_are_refused(site: str, token: str) -> None:
    """GET requests need no Origin, but may start long computations."""
    guard = Guard(_nothing, access=Access(token))
    script = [(b"authorization", f"Bearer {token}".encode())] * bool(token)

    def result(site: str, mode: str, destination: str) -> str:
        values = {"site": site, "mode": mode, "dest": destination}
        headers = [(b"host", b"localhost"), *((f"sec-fetch-{n}".encode(), v.encode()) for n, v in values.items())]
        return refusal(guard, scope("localhost") | {"headers": headers + script})

    for mode, destination in (("no-cors", "image"), ("cors", "empty"), ("navigate", "iframe"), ("no-cors", "script")):
        assert "another site" in result(site, mode, destination)
        assert result("same-origin", mode, destination) == ""
    assert result(site, "navigate", "document") == "", "a link"
    assert result("none", "navigate", "document") == "", "the address bar"


def test_two_host_headers_are_refused() -> None:
    both = scope("localhost") | {"headers": [(b"host", b"localhost"), (b"host", b"evil.example")]}
    assert "one Host" in refusal(Guard(_nothing), both)


def test_ipv6_host() -> None:
    assert refusal(Guard(_nothing, ["fe80::1"]), scope("[fe80::1]:8000")) == ""


def test_refusal_states_the_reason(shared_client: TestClient) -> None:
    answer = shared_client.get("/healthz", headers={"Host": "evil.example"})
    assert answer.status_code == 403
    assert answer.json()["error"].startswith("Host 'evil.example' is not allowed. Allowed: ")
    answer = shared_client.post("/api/views", headers={"Origin": "http://evil.example"})
    assert answer.status_code == 403
    assert "http://evil.example" in answer.json()["error"]


@pytest.mark.parametrize("path", ["/api/views/{}", "/scene/{}"])
def test_sockets_are_checked(shared_client: TestClient, path: str) -> None:
    view = shared_client.post("/api/views").json()["view"]
    for headers in ({"Origin": "http://evil.example"}, {"Host": "evil.example"}):
        with (
            pytest.raises(WebSocketDenialResponse) as refused,
            shared_client.websocket_connect(path.format(view), headers=headers),
        ):
            pass
        assert refused.value.status_code == 403
        assert refused.value.json()["error"]


@pytest.mark.parametrize("path", ["/api/views/{}", "/scene/{}", "/api/live/{}"])
@pytest.mark.parametrize("name", ["x" * 3000, "%E2%82%AC" * 500])
def test_close_reason_is_truncated(shared_client: TestClient, path: str, name: str) -> None:
    with shared_client.websocket_connect(path.format(name)) as socket:
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
def test_security_headers(shared_client: TestClient, path: str) -> None:
    headers = shared_client.get(path).headers
    assert {name: headers.get(name) for name in ALWAYS} == ALWAYS
    assert "camera=()" in headers["permissions-policy"]
    assert "microphone=()" in headers["permissions-policy"]
    assert "server" not in headers
    policy = headers["content-security-policy"]
    assert "http" not in policy, "no content of other hosts"
    assert "'unsafe-eval'" not in policy


def test_refusal_has_security_headers(shared_client: TestClient) -> None:
    headers = shared_client.get("/healthz", headers={"Host": "evil.example"}).headers
    assert {name: headers.get(name) for name in ALWAYS} == ALWAYS


def test_framing(shared_client: TestClient) -> None:
    scene = shared_client.post("/api/views").json()["scene"]
    for path, ancestors, frame_options in (
        ("/", "'none'", "DENY"),
        ("/api/jobs", "'none'", "DENY"),
        (scene, "'self'", "SAMEORIGIN"),
    ):
        headers = shared_client.get(path).headers
        assert f"frame-ancestors {ancestors};" in headers["content-security-policy"]
        assert headers["x-frame-options"] == frame_options


def test_inline_scripts_are_limited_to_the_scene(shared_client: TestClient) -> None:
    scene = shared_client.post("/api/views").json()["scene"]
    assert "script-src 'self' 'unsafe-inline'" in shared_client.get(scene).headers["content-security-policy"]
    assert "script-src 'self' 'wasm-unsafe-eval';" in shared_client.get("/").headers["content-security-policy"]


def test_data_is_sandboxed(shared_client: TestClient) -> None:
    for path in ("/api/catalog", "/static/icon.svg", "/vendor/rerun/viewer.js"):
        policy = shared_client.get(path).headers["content-security-policy"]
        assert policy.startswith("default-src 'none';")
        assert policy.endswith("sandbox")


def test_body_size_is_limited(shared_client: TestClient) -> None:
    def chunks() -> Iterator[bytes]:
        for _ in range(20):
            yield b" " * (MAX_BODY // 10)

    for body in (b" " * (MAX_BODY + 1), chunks()):
        answer = shared_client.post("/api/recordings", content=body, headers={"content-type": "application/json"})
        assert answer.status_code == 413
        assert str(MAX_BODY) in answer.json()["error"]
    assert shared_client.post("/api/views", content=b" " * 1000 + b'{"dark": true}', headers=JSON).status_code == 201


def test_body_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(security, "BODY_TIMEOUT", 0.01)

    async def body() -> dict[str, object]:
        await asyncio.sleep(10.0)
        return {}

    async def application(scope: Scope, receive: Receive, send: Send) -> None:
        with pytest.raises(HTTPException) as error:
            await receive()
        assert error.value.status_code == 408

    sent: list[object] = []

    async def send(message: object) -> None:
        sent.append(message)

    request = scope("localhost", "http://localhost", "POST")
    asyncio.run(Guard(application)(request, body, send))  # type: ignore[arg-type]
    assert not sent


def test_error_id_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    async def fails(scope: Scope, receive: Receive, send: Send) -> None:
        raise ZeroDivisionError("at the wrong moment")

    answer = TestClient(Guard(fails), base_url="http://localhost").get("/")
    assert answer.status_code == 500
    match = re.fullmatch(r"at the wrong moment \(error ([0-9a-f]{8})\)", answer.json()["error"])
    assert match
    assert answer.headers["x-content-type-options"] == "nosniff"
    (record,) = caplog.records
    assert record.event["error"] == match[1]  # type: ignore[attr-defined]
    assert record.exc_info


def test_configured_host_is_allowed(settings: Settings) -> None:
    with TestClient(create_app(replace(settings, hosts=("lab",)), warm=False), base_url="http://lab:8000") as client:
        assert client.get("/healthz").json()["status"] == "ok"
