"""Connections that take no part in HTTP or in a WebSocket: how many there may be, and when they end."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest
import uvicorn
from starlette.types import Receive, Scope, Send

from beliefscope.app.server import main, timeouts
from beliefscope.app.server.timeouts import MAX_FRAMES, HTTPProtocol, WebSocketProtocol

SECONDS = 20.0
UPGRADE = (
    "Host: localhost\r\nConnection: upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
)
SOCKET = f"GET / HTTP/1.1\r\n{UPGRADE}\r\n"
TEXT, PART, PING, LAST = 1, 0, 9, 0x80


async def _listens(scope: Scope, receive: Receive, send: Send) -> None:
    """A socket that is listened to; whoever asks over HTTP is sent more than he can be without reading."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        while (await receive())["type"] != "websocket.disconnect":
            pass
        return
    await send({"type": "http.response.start", "status": 200, "headers": []})
    for _ in range(1000):
        await send({"type": "http.response.body", "body": bytes(1 << 16), "more_body": True})


@pytest.fixture
def running(monkeypatch: pytest.MonkeyPatch) -> Iterator[uvicorn.Server]:
    """Listens as ``serve`` does, with few buffers, and gives up half a second after nothing is taken any more."""
    monkeypatch.setattr(main, "UNREAD_TIMEOUT", 500)
    config = uvicorn.Config(_listens, log_level="critical", http=HTTPProtocol, ws=WebSocketProtocol, lifespan="off")
    with main._listen("127.0.0.1", 0) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 14)
        running = uvicorn.Server(config)
        thread = threading.Thread(target=running.run, kwargs={"sockets": [listener]})
        thread.start()
        while not running.started:
            time.sleep(0.01)
        yield running
        running.should_exit = True
        thread.join(SECONDS)


def called(running: uvicorn.Server, head: str) -> socket.socket:
    """A connection that has said so much."""
    caller = socket.socket()
    caller.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 12)
    caller.settimeout(SECONDS)
    caller.connect(running.servers[0].sockets[0].getsockname())
    caller.sendall(head.encode())
    return caller


def frame(kind: int, content: bytes = b"") -> bytes:
    """Of fewer than 126 bytes, masked with zeros."""
    return bytes([kind, 0x80 | len(content), 0, 0, 0, 0]) + content


def soon(true: Callable[[], bool]) -> bool:
    end = time.monotonic() + SECONDS
    while not true() and time.monotonic() < end:
        time.sleep(0.01)
    return true()


@pytest.mark.parametrize(
    "head",
    [
        f"POST / HTTP/1.1\r\n{UPGRADE}\r\n",
        f"GET / HTTP/1.1\r\n{UPGRADE}Content-Length: 5\r\n\r\n",
        f"GET / HTTP/1.1\r\n{UPGRADE}X: {'x' * 20000}\r\n\r\n",
        f"GET / HTTP/1.1\r\n{UPGRADE}" + "".join(f"X-{i}: x\r\n" for i in range(300)) + "\r\n",
    ],
    ids=["another method", "with a body", "a long line", "many lines"],
)
def test_what_is_no_websocket_is_closed(running: uvicorn.Server, head: str) -> None:
    with called(running, head) as caller:
        assert caller.recv(100).startswith(b"HTTP/1.1 400 ")
        assert soon(lambda: not running.server_state.connections)


def test_there_are_so_many_connections_sockets_among_them(
    running: uvicorn.Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(timeouts, "MAX_CONNECTIONS", 2)
    first, second = called(running, SOCKET), called(running, SOCKET)
    assert first.recv(12) == second.recv(12) == b"HTTP/1.1 101"
    with called(running, "") as third:
        assert third.recv(12) == b"HTTP/1.1 503"
    first.close()
    assert soon(lambda: len(running.server_state.connections) == 1)
    with called(running, SOCKET) as fourth:
        assert fourth.recv(12) == b"HTTP/1.1 101"
    second.close()


def test_pongs_do_not_pile_up_for_who_does_not_read(running: uvicorn.Server) -> None:
    with called(running, SOCKET) as caller:
        assert caller.recv(12) == b"HTTP/1.1 101"
        caller.settimeout(0.1)
        pings, most, end = frame(PING | LAST, b"x" * 125) * 1000, 0, time.monotonic() + 1.5
        while time.monotonic() < end and running.server_state.connections:
            with contextlib.suppress(OSError):  # it is not read any more, or let go
                caller.sendall(pings)
            most = max([most, *(one.transport.get_write_buffer_size() for one in running.server_state.connections)])
        # 64 KB after which asyncio calls it full, and the pongs to what it reads at once, 256 KB.
        assert most < 400_000


def test_a_message_has_so_many_parts_at_most(running: uvicorn.Server) -> None:
    with called(running, SOCKET) as caller:
        while not caller.recv(4096).endswith(b"\r\n\r\n"):
            pass
        caller.sendall(
            frame(TEXT, b"a") + frame(PART) * (MAX_FRAMES - 2) + frame(PART | LAST) + frame(PING | LAST, b"still")
        )
        assert caller.recv(100).endswith(b"still")
        caller.sendall(frame(TEXT, b"a") + frame(PART) * 2 * MAX_FRAMES)
        said = caller.recv(100)
        assert (said[0], said[2:4]) == (0x88, (1009).to_bytes(2))


@pytest.mark.skipif(not hasattr(socket, "TCP_USER_TIMEOUT"), reason="the system has no such limit")
def test_who_takes_nothing_is_let_go(running: uvicorn.Server) -> None:
    with called(running, "GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"):
        assert soon(lambda: len(running.server_state.connections) == 1)
        assert soon(lambda: not running.server_state.connections)
