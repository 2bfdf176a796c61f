"""The token: who is let in, how a browser comes by its cookie, and that neither is told to anyone."""

from __future__ import annotations

import io
import logging
import re
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient, WebSocketDenialResponse

from beliefscope.app.server import logs
from beliefscope.app.server.auth import PERIOD, MIN_LENGTH, MAX_ATTEMPTS, VARIABLE, Access, SignIn, TooManyAttempts, host_names, token_for
from beliefscope.app.runs.settings import Settings
from beliefscope.app.server.main import create_app, serve
from beliefscope.datasets.errors import BadInput

TOKEN = "k7-Zq0_long-enough-to-be-one"
BEARER = {"Authorization": f"Bearer {TOKEN}"}
ORIGIN = {"Origin": "http://lab:8000"}


@pytest.fixture
def client(settings: Settings) -> Iterator[TestClient]:
    """Of a server that asks for a token, called from another machine."""
    app = create_app(replace(settings, hosts=("lab",)), warm=False, access=Access(TOKEN))
    with TestClient(app, base_url="http://lab:8000", follow_redirects=False, client=("10.0.0.7", 50000)) as client:
        yield client


def signed_in(client: TestClient) -> TestClient:
    assert client.get("/", params={"token": TOKEN}).status_code == 200
    assert client.cookies
    return client


@pytest.mark.parametrize("path", ["/api/catalog", "/static/core/main.js", "/vendor/rerun/viewer.js", "/nowhere"])
def test_without_a_token_nothing_is_told(client: TestClient, path: str) -> None:
    answer = client.get(path)
    assert answer.status_code == 401
    assert answer.headers["www-authenticate"] == "Bearer"
    assert answer.json() == {"error": answer.json()["error"]}
    assert client.get("/healthz").json()["status"] == "ok"


def test_the_page_asks_for_it(client: TestClient) -> None:
    answer = client.get("/")
    assert answer.status_code == 401
    assert answer.headers["content-type"].startswith("text/html")
    assert 'name="token"' in answer.text
    assert "core/main.js" not in answer.text
    led = client.get("/", params={"task": "push", "faults": 'a&b="<c>'})  # a link of a report's, for one
    assert '<a href="/?task=push&amp;faults=a%26b%3D%22%3Cc%3E">go on</a>' in led.text
    assert answer.headers["cache-control"] == "no-store"


def test_the_link_becomes_a_cookie_and_the_token_leaves_the_address(client: TestClient) -> None:
    answer = client.get("/", params={"task": "push", "token": TOKEN, "faults": "a&b=<c>"})
    assert answer.status_code == 200
    cookie = answer.headers["set-cookie"]
    assert re.fullmatch(r"beliefscope-8000=[\w-]{40,}; Path=/; HttpOnly; SameSite=Strict", cookie)
    assert TOKEN not in cookie
    assert TOKEN not in answer.text
    assert "0;url=/?task=push&amp;faults=a%26b%3D%3Cc%3E" in answer.text
    assert "<title>Beliefscope" in client.get("/").text
    assert client.get("/api/jobs").json() == []
    again = client.get("/", params={"token": "of the server before", "task": "push"})
    assert (again.status_code, again.headers["location"]) == (303, "/?task=push")


def test_a_script_brings_it_each_time_and_needs_no_origin(client: TestClient) -> None:
    assert client.get("/api/jobs", headers=BEARER).json() == []
    assert client.post("/api/views", headers=BEARER).status_code == 201
    assert client.post("/api/views", headers=BEARER | {"Origin": "http://evil.example"}).status_code == 403
    assert client.post("/api/views", headers={"Authorization": f"Basic {TOKEN}"}).status_code == 401


def test_a_cookie_does_not_make_another_page_ours(client: TestClient) -> None:
    signed_in(client)
    assert client.post("/api/views").status_code == 403
    assert client.post("/api/views", headers={"Origin": "http://evil.example"}).status_code == 403
    assert client.post("/api/views", headers=ORIGIN).status_code == 201


@pytest.mark.parametrize("path", ["/api/views/{}", "/scene/{}"])
def test_sockets_ask_for_it_too(client: TestClient, path: str) -> None:
    view = client.post("/api/views", headers=BEARER).json()["view"]
    address = "ws://lab:8000" + path.format(view)
    for headers in (ORIGIN, ORIGIN | {"Authorization": "Bearer another-one-altogether"}):
        with pytest.raises(WebSocketDenialResponse) as refused, client.websocket_connect(address, headers=headers):
            pass
        assert refused.value.status_code == 401
    with client.websocket_connect(address, headers=BEARER):
        pass
    with signed_in(client).websocket_connect(address, headers=ORIGIN):
        pass


def test_the_cookie_of_another_server_on_this_machine_is_none(settings: Settings, client: TestClient) -> None:
    signed_in(client)
    other = create_app(replace(settings, hosts=("lab",)), warm=False, access=Access(TOKEN))
    with TestClient(other, base_url="http://lab:8000", cookies=dict(client.cookies)) as later:
        assert later.get("/api/jobs").status_code == 401
    # What other servers of the host set, however odd, is not in the way.
    cookies = "; ".join(['odd={"a": [1, 2]}', "beliefscope-9000=x", *(f"{k}={v}" for k, v in client.cookies.items())])
    assert client.get("/api/jobs", headers={"Cookie": cookies}).status_code == 200


def test_with_a_token_the_machine_is_known_by_its_addresses(client: TestClient) -> None:
    for host, status in (
        ("10.0.0.5:8000", 200),
        ("[fe80::1]:8000", 200),
        ("evil.example", 403),
        ("10.0.0.5.evil", 403),
    ):
        assert client.get("/api/jobs", headers=BEARER | {"Host": host}).status_code == status


def test_who_guesses_has_to_wait(client: TestClient) -> None:
    signed_in(client)
    for _ in range(MAX_ATTEMPTS):
        assert client.get("/api/jobs", headers={"Authorization": "Bearer wrong"}).status_code == 401
    answer = client.get("/api/jobs", headers=BEARER)
    assert answer.status_code == 429
    assert 1 <= int(answer.headers["retry-after"]) <= PERIOD
    assert client.get("/api/jobs").status_code == 200, "who is in stays in"


def test_waiting_is_by_address_and_ends() -> None:
    now = [0.0]
    sign_in = SignIn(TOKEN, clock=lambda: now[0])
    for _ in range(MAX_ATTEMPTS):
        assert not sign_in.accepts("wrong", "10.0.0.7")
    with pytest.raises(TooManyAttempts):
        sign_in.accepts(TOKEN, "10.0.0.7")
    assert sign_in.accepts(TOKEN, "10.0.0.8")
    now[0] = PERIOD + 1.0
    assert sign_in.accepts(TOKEN, "10.0.0.7")


def test_addresses_are_not_remembered_without_end() -> None:
    sign_in = SignIn(TOKEN)
    for i in range(3000):
        sign_in.accepts("wrong", f"10.{i // 65536}.{i // 256 % 256}.{i % 256}")
    assert len(sign_in._wrong) <= 1000


def test_nobody_locks_out_who_shares_an_address() -> None:
    own = token_for("0.0.0.0", False, {})
    sign_in = SignIn(own)
    for _ in range(MAX_ATTEMPTS):
        assert not sign_in.accepts("wrong", "10.0.0.7")
    with pytest.raises(TooManyAttempts):
        sign_in.accepts("wrong", "10.0.0.7")
    assert sign_in.accepts(own, "10.0.0.7")
    assert not sign_in.accepts(own.swapcase(), "10.0.0.8")


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "10.0.0.5", "lab", ""])
def test_beyond_the_loopback_there_is_always_a_token(settings: Settings, host: str) -> None:
    made = token_for(host, False, {})
    assert len(made) >= 40
    assert made != token_for(host, False, {})
    with pytest.raises(BadInput, match=f"needs a token.*{VARIABLE}"):
        serve(settings, host=host, port=0)


def test_on_the_loopback_there_is_one_where_it_is_asked_for() -> None:
    for host in ("127.0.0.1", "localhost", "::1"):
        assert token_for(host, False, {}) == ""
        assert token_for(host, True, {})
        assert token_for(host, False, {VARIABLE: TOKEN}) == TOKEN


@pytest.mark.parametrize("token", ["short", "x" * (MIN_LENGTH - 1), "with spaces in between", "über-lange-geheime-worte"])
def test_a_token_that_could_be_guessed_is_none(token: str) -> None:
    with pytest.raises(BadInput, match=VARIABLE) as error:
        token_for("127.0.0.1", False, {VARIABLE: token})
    assert token not in str(error.value)


def test_the_printed_name_can_be_opened() -> None:
    assert host_names("lab") == ("lab",)
    assert host_names("0.0.0.0")[0] != "0.0.0.0"


@pytest.mark.parametrize("form", logs.FORMATS)
@pytest.mark.usefixtures("restored")
def test_the_log_never_holds_it(client: TestClient, form: str) -> None:
    stream = io.StringIO()
    logs.configure("debug", form, TOKEN, stream)
    client.get("/", params={"token": "a-wrong-one-of-mine"})
    client.get(f"/api/{TOKEN}", headers={"Host": f"{TOKEN}.example"})
    signed_in(client).get("/api/jobs")
    client.get("/api/nowhere", headers={"Authorization": f"Bearer {TOKEN[:-1]}"})
    logging.getLogger("beliefscope.app").error("at /?token=%s&task=door, Bearer %s", TOKEN, "abc")
    said = stream.getvalue()
    assert said.count("refused: ") >= 3
    assert TOKEN not in said
    assert "a-wrong-one-of-mine" not in said
    assert "Bearer abc" not in said
    assert not any(value in said for value in client.cookies.values())
    assert TOKEN not in repr(Access(TOKEN))


@pytest.fixture
def restored() -> Iterator[None]:
    """Puts the loggers back."""
    names = ("beliefscope", "uvicorn.error")
    before = [(logger.handlers, logger.level) for logger in map(logging.getLogger, names)]
    yield
    for name, (handlers, level) in zip(names, before, strict=True):
        logger = logging.getLogger(name)
        logger.handlers = handlers
        logger.setLevel(level)


def test_a_read_only_server_changes_nothing(settings: Settings, open_client: Callable[..., TestClient]) -> None:
    app = create_app(settings, warm=False, access=Access(read_only=True))
    refused, run = [], {"task": "door", "filter": "crossmodal-ekf", "episode": 1}
    with TestClient(app, base_url="http://localhost:8000", headers={"Origin": "http://localhost:8000"}) as client:
        view = client.post("/api/views").json()["view"]
        with client.websocket_connect(f"ws://localhost:8000/api/views/{view}") as socket:
            socket.send_json({"type": "theme", "dark": True})
        assert client.get("/api/catalog").json()["read_only"] is True
        for method, path in changing(app):
            answer = client.request(method, re.sub(r"\{.*?\}", "x", path), json=run)
            assert answer.status_code == 403, (method, path)
            assert "read-only" in answer.json()["error"]
            refused.append((method, path))
    assert len(refused) > 10
    assert ("POST", "/api/recordings") in refused
    assert not list((settings.workspace / "jobs").glob("*"))
    with open_client(settings) as client:
        assert client.get("/api/catalog").json()["read_only"] is False
        assert client.post("/api/recordings", json=run).status_code == 201
    app = create_app(settings, warm=False, access=Access(read_only=True))
    with TestClient(app, base_url="http://localhost:8000", headers={"Origin": "http://localhost:8000"}) as client:
        again = client.post("/api/recordings", json=run)
        assert (again.status_code, again.json()["seconds"]) == (200, None), "what is there is shown"


def changing(app: FastAPI) -> Iterator[tuple[str, str]]:
    """Method and path of every route that changes something; the one that opens a view does not."""
    for path, methods in app.openapi()["paths"].items():
        yield from ((method.upper(), path) for method in methods if method != "get" and path != "/api/views")
