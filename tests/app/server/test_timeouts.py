"""Limits of connections and WebSockets."""

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

pytestmark = pytest.mark.slow

SECONDS = 20.0
UPGRADE = (
    "Host: localhost\r\nConnection: upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
)
SOCKET = f"GET / HTTP/1.1\r\n{UPGRADE}\r\n"
TEXT, PART, PING, LAST = 1, 0, 9, 0x80


async def _application(scope: Scope, receive: Receive, send: Send) -> None:
    """Reads all WebSocket messages; HTTP responses exceed the buffers of a client that does not read."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        while (await receive())["type"] != "websocket.disconnect":
            pass
        return
    await send({"type": "http.response.start", "status": 200, "headers": []})
    for _ in range(1000):
        await send({"type": "http.response.body", "body": bytes(1 << 16), "more_body": True})


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[uvicorn.Server]:
    """A server like that of ``serve``, with small buffers and a short timeout for unread data."""
    monkeypatch.setattr(main, "UNREAD_TIMEOUT", 500)
    config = uvicorn.Config(_application, log_level="critical", http=HTTPProtocol, ws=WebSocketProtocol, lifespan="off")
    with main.listen("127.0.0.1", 0) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 14)
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        while not server.started:
            time.sleep(0.01)
        yield server
        server.should_exit = True
        thread.join(SECONDS)


def connect(server: uvicorn.Server, head: str) -> socket.socket:
    """A connection that has sent ``head``."""
    client = socket.socket()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 12)
    client.settimeout(SECONDS)
    client.connect(server.servers[0].sockets[0].getsockname())
    client.sendall(head.encode())
    return client


def frame(kind: int, content: bytes = b"") -> bytes:
    """A frame of fewer than 126 bytes, masked with zeros."""
    return bytes([kind, 0x80 | len(content), 0, 0, 0, 0]) + content


def becomes_true(condition: Callable[[], bool]) -> bool:
    end = time.monotonic() + SECONDS
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)
    return condition()


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
def test_failed_handshakes_are_closed(server: uvicorn.Server, head: str) -> None:
    with connect(server, head) as client:
        assert client.recv(100).startswith(b"HTTP/1.1 400 ")
        assert becomes_true(lambda: not server.server_state.connections)


def test_number_of_connections_is_limited(server: uvicorn.Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timeouts, "MAX_CONNECTIONS", 2)
    first, second = connect(server, SOCKET), connect(server, SOCKET)
    assert first.recv(12) == second.recv(12) == b"HTTP/1.1 101"
    with connect(server, "") as third:
        assert third.recv(12) == b"HTTP/1.1 503"
    first.close()
    assert becomes_true(lambda: len(server.server_state.connections) == 1)
    with connect(server, SOCKET) as fourth:
        assert fourth.recv(12) == b"HTTP/1.1 101"
    second.close()


def test_pongs_do_not_accumulate(server: uvicorn.Server) -> None:
    with connect(server, SOCKET) as client:
        assert client.recv(12) == b"HTTP/1.1 101"
        client.settimeout(0.1)
        pings, maximum, end = frame(PING | LAST, b"x" * 125) * 1000, 0, time.monotonic() + 1.5
        while time.monotonic() < end and server.server_state.connections:
            with contextlib.suppress(OSError):  # not read, or closed
                client.sendall(pings)
            sizes = (c.transport.get_write_buffer_size() for c in server.server_state.connections)
            maximum = max([maximum, *sizes])
        # asyncio's high-water mark of 64 KB, and the pongs to one read of 256 KB.
        assert maximum < 400_000


def test_number_of_frames_is_limited(server: uvicorn.Server) -> None:
    with connect(server, SOCKET) as client:
        while not client.recv(4096).endswith(b"\r\n\r\n"):
            pass
        client.sendall(
            frame(TEXT, b"a") + frame(PART) * (MAX_FRAMES - 2) + frame(PART | LAST) + frame(PING | LAST, b"still")
        )
        assert client.recv(100).endswith(b"still")
        client.sendall(frame(TEXT, b"a") + frame(PART) * 2 * MAX_FRAMES)
        reply = client.recv(100)
        assert (reply[0], reply[2:4]) == (0x88, (1009).to_bytes(2))


@pytest.mark.skipif(not hasattr(socket, "TCP_USER_TIMEOUT"), reason="the system has no such limit")
def test_clients_that_do_not_read_are_disconnected(server: uvicorn.Server) -> None:
    with connect(server, "GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"):
        assert becomes_true(lambda: len(server.server_state.connections) == 1)
        assert becomes_true(lambda: not server.server_state.connections)
