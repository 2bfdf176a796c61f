"""The guard: who is let in, over HTTP and WebSockets alike, and what every answer carries."""

from __future__ import annotations

from dataclasses import replace

import pytest
from starlette.testclient import TestClient, WebSocketDenialResponse
from starlette.types import Scope

from beliefscope.app.security import Guard
from beliefscope.app.server import Settings, create_app


async def _nothing(*_: object) -> None:
    raise AssertionError("the guard's own rules do not call the application")


def scope(host: str, origin: str | None = None, method: str | None = "GET") -> Scope:
    headers = [(b"host", host.encode())] + ([] if origin is None else [(b"origin", origin.encode())])
    kind = {"type": "websocket"} if method is None else {"type": "http", "method": method}
    return kind | {"headers": headers, "path": "/"}


@pytest.mark.parametrize(
    "host", ["localhost", "localhost:8000", "LOCALHOST:1", "127.0.0.1:9", "[::1]:8000", "lab:8000"]
)
def test_a_known_name_at_any_port_may_read(host: str) -> None:
    assert Guard(_nothing, ["lab"]).problem(scope(host)) is None


@pytest.mark.parametrize(
    "host",
    ["evil.example", "evil.example:8000", "localhost.evil.example", "127.0.0.1.evil.example", "[::2]", "", "lab"],
)
def test_another_name_may_not_even_read(host: str) -> None:
    assert "is not answered here" in (Guard(_nothing).problem(scope(host)) or "")


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", None])
@pytest.mark.parametrize(
    "origin",
    [None, "null", "http://evil.example", "http://localhost:8001", "http://localhost", "file://localhost:8000"],
)
def test_what_changes_something_comes_from_our_own_page(method: str | None, origin: str | None) -> None:
    guard = Guard(_nothing)
    assert "Origin" in (guard.problem(scope("localhost:8000", origin, method)) or "")
    assert guard.problem(scope("localhost:8000", "http://localhost:8000", method)) is None


def test_two_hosts_are_none() -> None:
    both = scope("localhost") | {"headers": [(b"host", b"localhost"), (b"host", b"evil.example")]}
    assert Guard(_nothing).problem(both) is not None


def test_an_ipv6_name_is_known_by_its_brackets() -> None:
    assert Guard(_nothing, ["fe80::1"]).problem(scope("[fe80::1]:8000")) is None


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


def test_every_answer_has_the_security_headers(client: TestClient) -> None:
    for path in ("/healthz", "/api/catalog", "/nowhere", "/api/trace/door/none/0"):
        headers = client.get(path).headers
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["cross-origin-resource-policy"] == "same-origin"
        policy = headers["content-security-policy"]
        assert "connect-src 'self';" in policy
        assert "frame-ancestors 'self'" in policy
        assert "script-src 'self' 'wasm-unsafe-eval';" in policy


def test_only_the_scene_may_run_inline_scripts(client: TestClient) -> None:
    scene = client.post("/api/views").json()["scene"]
    policy = client.get(scene).headers["content-security-policy"]
    assert "script-src 'self' 'unsafe-inline'" in policy
    assert "frame-ancestors 'self'" in policy


def test_a_given_name_is_answered(settings: Settings) -> None:
    with TestClient(create_app(replace(settings, hosts=("lab",)), warm=False), base_url="http://lab:8000") as client:
        assert client.get("/healthz").json()["status"] == "ok"
