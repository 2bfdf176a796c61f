"""Authentication: token, cookie, attempt limit, and secrecy in logs."""

from __future__ import annotations

import io
import logging
import re
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient, WebSocketDenialResponse

from beliefscope.app.runs.settings import Settings
from beliefscope.app.server import logs
from beliefscope.app.server.auth import (
    MAX_ATTEMPTS,
    MIN_LENGTH,
    PERIOD,
    VARIABLE,
    Access,
    SignIn,
    TooManyAttempts,
    host_names,
    token_for,
)
from beliefscope.app.server.main import create_app, serve
from beliefscope.datasets.errors import BadInput

pytestmark = pytest.mark.slow

TOKEN = "k7-Zq0_a-token-for-these-tests"
BEARER = {"Authorization": f"Bearer {TOKEN}"}
ORIGIN = {"Origin": "http://lab:8000"}


@pytest.fixture
def client(settings: Settings) -> Iterator[TestClient]:
    """Client on another machine; the server requires a token."""
    app = create_app(replace(settings, hosts=("lab",)), warm=False, access=Access(TOKEN))
    with TestClient(app, base_url="http://lab:8000", follow_redirects=False, client=("10.0.0.7", 50000)) as client:
        yield client


def sign_in(client: TestClient) -> TestClient:
    assert client.get("/", params={"token": TOKEN}).status_code == 200
    assert client.cookies
    return client


def test_requests_without_token_are_refused(client: TestClient) -> None:
    for path in ("/api/catalog", "/static/core/main.js", "/vendor/rerun/viewer.js", "/nowhere"):
        answer = client.get(path)
        assert answer.status_code == 401, path
        assert answer.headers["www-authenticate"] == "Bearer", path
        assert answer.json() == {"error": answer.json()["error"]}
    assert client.get("/healthz").json()["status"] == "ok"


def test_sign_in_page(client: TestClient) -> None:
    answer = client.get("/")
    assert answer.status_code == 401
    assert answer.headers["content-type"].startswith("text/html")
    assert 'name="token"' in answer.text
    assert "core/main.js" not in answer.text
    linked = client.get("/", params={"task": "push", "faults": 'a&b="<c>'})
    assert '<a href="/?task=push&amp;faults=a%26b%3D%22%3Cc%3E">Continue</a>' in linked.text
    assert answer.headers["cache-control"] == "no-store"


def test_link_sets_cookie_and_removes_token_from_address(client: TestClient) -> None:
    answer = client.get("/", params={"task": "push", "token": TOKEN, "faults": "a&b=<c>"})
    assert answer.status_code == 200
    cookie = answer.headers["set-cookie"]
    assert re.fullmatch(r"beliefscope-8000=[\w-]{40,}; Path=/; HttpOnly; SameSite=Strict", cookie)
    assert TOKEN not in cookie
    assert TOKEN not in answer.text
    assert "0;url=/?task=push&amp;faults=a%26b%3D%3Cc%3E" in answer.text
    assert "<title>Beliefscope" in client.get("/").text
    assert client.get("/api/jobs").json() == []
    again = client.get("/", params={"token": "of-an-earlier-server", "task": "push"})
    assert (again.status_code, again.headers["location"]) == (303, "/?task=push")


def test_script_with_bearer_token_needs_no_origin(client: TestClient) -> None:
    assert client.get("/api/jobs", headers=BEARER).json() == []
    assert client.post("/api/views", headers=BEARER).status_code == 201
    assert client.post("/api/views", headers=BEARER | {"Origin": "http://evil.example"}).status_code == 403
    assert client.post("/api/views", headers={"Authorization": f"Basic {TOKEN}"}).status_code == 401


def test_cookie_does_not_replace_origin(client: TestClient) -> None:
    sign_in(client)
    assert client.post("/api/views").status_code == 403
    assert client.post("/api/views", headers={"Origin": "http://evil.example"}).status_code == 403
    assert client.post("/api/views", headers=ORIGIN).status_code == 201


@pytest.mark.parametrize("path", ["/api/views/{}", "/scene/{}"])
def test_sockets_require_token(client: TestClient, path: str) -> None:
    view = client.post("/api/views", headers=BEARER).json()["view"]
    address = "ws://lab:8000" + path.format(view)
    for headers in (ORIGIN, ORIGIN | {"Authorization": "Bearer another-one-altogether"}):
        with pytest.raises(WebSocketDenialResponse) as refused, client.websocket_connect(address, headers=headers):
            pass
        assert refused.value.status_code == 401
    with client.websocket_connect(address, headers=BEARER):
        pass
    with sign_in(client).websocket_connect(address, headers=ORIGIN):
        pass


def test_cookies_of_other_servers_are_ignored(settings: Settings, client: TestClient) -> None:
    sign_in(client)
    other = create_app(replace(settings, hosts=("lab",)), warm=False, access=Access(TOKEN))
    with TestClient(other, base_url="http://lab:8000", cookies=dict(client.cookies)) as later:
        assert later.get("/api/jobs").status_code == 401
    # Malformed cookies of other servers on the host.
    cookies = "; ".join(['odd={"a": [1, 2]}', "beliefscope-9000=x", *(f"{k}={v}" for k, v in client.cookies.items())])
    assert client.get("/api/jobs", headers={"Cookie": cookies}).status_code == 200


def test_ip_addresses_are_valid_hosts_with_a_token(client: TestClient) -> None:
    for host, status in (
        ("10.0.0.5:8000", 200),
        ("[fe80::1]:8000", 200),
        ("evil.example", 403),
        ("10.0.0.5.evil", 403),
    ):
        assert client.get("/api/jobs", headers=BEARER | {"Host": host}).status_code == status


def test_attempts_are_limited(client: TestClient) -> None:
    sign_in(client)
    for _ in range(MAX_ATTEMPTS):
        assert client.get("/api/jobs", headers={"Authorization": "Bearer wrong"}).status_code == 401
    answer = client.get("/api/jobs", headers=BEARER)
    assert answer.status_code == 429
    assert 1 <= int(answer.headers["retry-after"]) <= PERIOD
    assert client.get("/api/jobs").status_code == 200, "a cookie stays valid"


def test_limit_is_per_address_and_expires() -> None:
    now = [0.0]
    checker = SignIn(TOKEN, clock=lambda: now[0])
    for _ in range(MAX_ATTEMPTS):
        assert not checker.accepts("wrong", "10.0.0.7")
    with pytest.raises(TooManyAttempts):
        checker.accepts(TOKEN, "10.0.0.7")
    assert checker.accepts(TOKEN, "10.0.0.8")
    now[0] = PERIOD + 1.0
    assert checker.accepts(TOKEN, "10.0.0.7")


def test_number_of_counted_addresses_is_limited() -> None:
    checker = SignIn(TOKEN)
    for i in range(3000):
        checker.accepts("wrong", f"10.{i // 65536}.{i // 256 % 256}.{i % 256}")
    assert len(checker._attempts) <= 1000


def test_restart_revokes_cookies() -> None:
    host = "localhost:8000"
    first, restarted = SignIn(TOKEN), SignIn(TOKEN)
    cookie = first.cookie(host).partition(";")[0]
    assert first.has_cookie(host, cookie)
    assert not restarted.has_cookie(host, cookie)


def test_generated_token_is_exempt_from_the_limit() -> None:
    token = token_for("0.0.0.0", False, {})
    checker = SignIn(token)
    for _ in range(MAX_ATTEMPTS):
        assert not checker.accepts("wrong", "10.0.0.7")
    with pytest.raises(TooManyAttempts):
        checker.accepts("wrong", "10.0.0.7")
    assert checker.accepts(token, "10.0.0.7")
    assert not checker.accepts(token.swapcase(), "10.0.0.8")


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "10.0.0.5", "lab", ""])
def test_token_is_required_beyond_loopback(settings: Settings, host: str) -> None:
    token = token_for(host, False, {})
    assert len(token) >= 40
    assert token != token_for(host, False, {})
    with pytest.raises(BadInput, match=f"set a token in {VARIABLE}"):
        serve(settings, host=host, port=0)


def test_token_is_optional_on_loopback() -> None:
    for host in ("127.0.0.1", "localhost", "::1"):
        assert token_for(host, False, {}) == ""
        assert token_for(host, True, {})
        assert token_for(host, False, {VARIABLE: TOKEN}) == TOKEN


@pytest.mark.parametrize("token", ["short", "x" * (MIN_LENGTH - 1), "with spaces in between", "not-ascii-über-über"])
def test_weak_tokens_are_refused(token: str) -> None:
    with pytest.raises(BadInput, match=VARIABLE) as error:
        token_for("127.0.0.1", False, {VARIABLE: token})
    assert token not in str(error.value)


def test_host_names() -> None:
    assert host_names("lab") == ("lab",)
    assert host_names("0.0.0.0")[0] != "0.0.0.0"


@pytest.mark.parametrize("form", ["text", "json"])
@pytest.mark.usefixtures("restore_loggers")
def test_log_contains_no_secrets(client: TestClient, form: str) -> None:
    stream = io.StringIO()
    logs.configure("debug", form, TOKEN, stream)
    client.get("/", params={"token": "a-wrong-token-value"})
    client.get(f"/api/{TOKEN}", headers={"Host": f"{TOKEN}.example"})
    sign_in(client).get("/api/jobs")
    client.get("/api/nowhere", headers={"Authorization": f"Bearer {TOKEN[:-1]}"})
    logging.getLogger("beliefscope.app").error("at /?token=%s&task=door, Bearer %s", TOKEN, "abc")
    text = stream.getvalue()
    assert text.count("refused: ") >= 3
    assert TOKEN not in text
    assert "a-wrong-token-value" not in text
    assert "Bearer abc" not in text
    assert not any(value in text for value in client.cookies.values())
    assert TOKEN not in repr(Access(TOKEN))


@pytest.fixture
def restore_loggers() -> Iterator[None]:
    """Restore the loggers after the test."""
    names = ("beliefscope", "uvicorn.error")
    before = [(logger.handlers, logger.level) for logger in map(logging.getLogger, names)]
    yield
    for name, (handlers, level) in zip(names, before, strict=True):
        logger = logging.getLogger(name)
        logger.handlers = handlers
        logger.setLevel(level)


def test_read_only_server(settings: Settings, open_client: Callable[..., TestClient]) -> None:
    app = create_app(settings, warm=False, access=Access(read_only=True))
    refused, body = [], {"task": "door", "filter": "crossmodal-ekf", "episode": 1}
    with TestClient(app, base_url="http://localhost:8000", headers={"Origin": "http://localhost:8000"}) as client:
        view = client.post("/api/views").json()["view"]
        with client.websocket_connect(f"ws://localhost:8000/api/views/{view}") as socket:
            socket.send_json({"type": "theme", "dark": True})
        assert client.get("/api/catalog").json()["read_only"] is True
        for method, path in mutating_routes(app):
            answer = client.request(method, re.sub(r"\{.*?\}", "x", path), json=body)
            assert answer.status_code == 403, (method, path)
            assert "read-only" in answer.json()["error"]
            refused.append((method, path))
    assert len(refused) > 10
    assert ("POST", "/api/recordings") in refused
    assert not list((settings.workspace / "jobs").glob("*"))
    with open_client(settings) as client:
        assert client.get("/api/catalog").json()["read_only"] is False
        assert client.post("/api/recordings", json=body).status_code == 201
    app = create_app(settings, warm=False, access=Access(read_only=True))
    with TestClient(app, base_url="http://localhost:8000", headers={"Origin": "http://localhost:8000"}) as client:
        again = client.post("/api/recordings", json=body)
        assert (again.status_code, again.json()["seconds"]) == (200, None), "an existing recording is returned"


def mutating_routes(app: FastAPI) -> Iterator[tuple[str, str]]:
    """Method and path of every route except GET routes and the one that opens a view."""
    for path, methods in app.openapi()["paths"].items():
        yield from ((method.upper(), path) for method in methods if method != "get" and path != "/api/views")
