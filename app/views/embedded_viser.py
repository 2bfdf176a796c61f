"""A viser server without a port of its own: its sockets come in through ours.

viser opens a port by itself, on every interface, and answers any Host and Origin. Here its socket handler is taken
from it while it is constructed, so that no port is opened, and is fed from a Starlette WebSocket behind our guard.
This leans on viser's insides (`viser` is pinned); `EmbeddedViser` fails loudly where they are not as expected.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import logging
import sys
import threading
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import rich
import viser
import viser.infra
import websockets.asyncio.server
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.exceptions import ConnectionClosedOK

WAITING = 64  # messages of a browser that viser has not taken yet
BROWSERS = 4  # of one scene, which is one page's: more than one only while a lost one is not known to be lost
HEARD = frozenset({viser._messages.GuiUpdateMessage})
"""What a browser can have viser do; and where each looks from, which every connection hears for itself.

It would do more: ask a host on the Internet to lead others here, or keep files that are sent to it, of any size.
"""
CLIENT = Path(viser.__file__).parent / "client" / "build" / "index.html"
if importlib.util.find_spec("cv2") is None:
    # viser asks for OpenCV at every picture, and looks along the whole path for it: half of what a picture takes.
    sys.modules["cv2"] = None  # type: ignore[assignment]
log = logging.getLogger("beliefscope.app")
# Construction and stop both touch what the whole process shares: one at a time.
_process_wide = threading.Lock()


def client_page(script: str) -> bytes:
    """viser's page with a script of ours, from that address, before its own. Raises RuntimeError if it has no head."""
    before, head, after = CLIENT.read_bytes().partition(b"<head>")
    if not head:
        raise RuntimeError(
            f"The page of viser {viser.__version__} has a page without <head>; embedded_viser.py needs one."
        )
    return before + head + f'<script src="{script}"></script>'.encode() + after


class _Connection:
    """What viser's handler sees of one browser: the part of ``ServerConnection`` that it uses.

    Lives in viser's event loop; the browser's socket lives in the server's.
    """

    def __init__(self, websocket: WebSocket, subprotocol: str, server_loop: asyncio.AbstractEventLoop) -> None:
        self.subprotocol = subprotocol
        self._websocket = websocket
        self._server_loop = server_loop
        self._incoming: asyncio.Queue[bytes | None] = asyncio.Queue(WAITING)

    async def put(self, message: bytes) -> None:
        """In viser's loop: a message from the browser, once there is room for it."""
        await self._incoming.put(message)

    def end(self) -> None:
        """In viser's loop: the browser has gone, and what it still said is of no interest."""
        while not self._incoming.empty():
            self._incoming.get_nowait()
        self._incoming.put_nowait(None)

    async def recv(self) -> bytes:
        message = await self._incoming.get()
        if message is None:
            raise ConnectionClosedOK(None, None)
        return message

    async def send(self, message: bytes) -> None:
        # Waiting for the browser's side gives viser its backpressure.
        try:
            await self._over_there(self._websocket.send_bytes(message))
        except (WebSocketDisconnect, RuntimeError) as error:
            raise ConnectionClosedOK(None, None) from error

    async def close(self, code: int = 1000, reason: str = "") -> None:
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            await self._over_there(self._websocket.close(code, reason))

    async def _over_there(self, work: Any) -> None:
        await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(work, self._server_loop))


Handler = Callable[[_Connection], Awaitable[None]]


class EmbeddedViser:
    """One viser server, reached only through ``connect``.

    Attributes:
        server: the public viser API: ``scene``, ``gui``, ``flush()``.

    Raises RuntimeError where the installed viser does not start its socket server the way it is known to.
    """

    def __init__(self) -> None:
        with _process_wide, _silence(), _captured_handler() as captured:
            self.server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        if len(captured) != 1:
            self.server.stop()
            raise RuntimeError(
                f"viser {viser.__version__} does not start its socket server through websockets.asyncio.server.serve; "
                "app/views/embedded_viser.py was written for viser 1.1."
            )
        handlers = self.server._websock_server._incoming_handlers
        for message in handlers.keys() - HEARD:
            self.server._websock_server.unregister_handler(message)
        if handlers.keys() != HEARD:
            self.server.stop()
            raise RuntimeError(f"viser {viser.__version__} has other message handlers than embedded_viser.py expects.")
        self._handler: Handler = captured[0]
        self._loop = self.server.get_event_loop()
        self._connections: dict[_Connection, None] = {}  # the oldest first

    @property
    def subprotocol(self) -> str:
        """What viser's own client of this version asks for."""
        return f"viser-v{viser.__version__}"

    async def connect(self, websocket: WebSocket) -> None:
        """Serve one browser until it, or ``close``, ends the connection. Another version's client is turned away."""
        if self.subprotocol not in websocket.scope["subprotocols"]:
            await websocket.accept()
            await websocket.close(1002, f"This scene speaks {self.subprotocol}.")
            return
        await websocket.accept(subprotocol=self.subprotocol)
        connection = _Connection(websocket, self.subprotocol, asyncio.get_running_loop())
        self._connections[connection] = None
        while len(self._connections) > BROWSERS:
            oldest = next(iter(self._connections))
            del self._connections[oldest]
            self._end(oldest)
        handling = asyncio.wrap_future(asyncio.run_coroutine_threadsafe(self._handle(connection), self._loop))
        receiving = asyncio.ensure_future(self._receive(websocket, connection))
        try:
            await asyncio.wait({handling, receiving}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            receiving.cancel()
            self._end(connection)
            await asyncio.wait({handling}, timeout=2.0)
            self._connections.pop(connection, None)
            with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                await websocket.close()

    async def _handle(self, connection: _Connection) -> None:
        try:
            await self._handler(connection)
        except Exception as error:  # of viser's, about a message that it cannot read
            log.debug("a scene's browser is sent away: %s", error)

    async def _receive(self, websocket: WebSocket, connection: _Connection) -> None:
        with contextlib.suppress(WebSocketDisconnect, KeyError):
            while True:
                message = await websocket.receive_bytes()
                # Waiting for viser gives the browser its backpressure.
                await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(connection.put(message), self._loop))

    def _end(self, connection: _Connection) -> None:
        with contextlib.suppress(RuntimeError):  # viser's loop has ended
            self._loop.call_soon_threadsafe(connection.end)

    def close(self) -> None:
        """End every connection and viser's threads. Blocks for up to a few seconds: call it in a worker thread."""
        for connection in tuple(self._connections):
            self._end(connection)
        with _process_wide, _silence():
            self.server.stop()


@contextlib.contextmanager
def _captured_handler() -> Iterator[list[Handler]]:
    """Replace ``websockets.asyncio.server.serve``; what viser gives it lands in the list, and nothing listens."""
    real = websockets.asyncio.server.serve
    captured: list[Handler] = []

    @contextlib.asynccontextmanager
    async def no_listener(handler: Handler) -> Any:
        captured.append(handler)
        yield SimpleNamespace(server=SimpleNamespace(sockets=()))
        # As a real server would: let the connections' handlers end before viser closes its loop.
        others = asyncio.all_tasks() - {asyncio.current_task()}
        if others:
            _, late = await asyncio.wait(others, timeout=1.0)
            for task in late:
                task.cancel()
            await asyncio.gather(*late, return_exceptions=True)

    def serve(handler: Any, *args: Any, **kwargs: Any) -> Any:
        if getattr(handler, "__module__", "") == viser.infra.WebsockServer.__module__:
            return no_listener(handler)
        return real(handler, *args, **kwargs)

    websockets.asyncio.server.serve = serve  # type: ignore[assignment, misc]
    try:
        yield captured
    finally:
        websockets.asyncio.server.serve = real  # type: ignore[misc]


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """viser prints a panel with its port, which is not open, and a line when it stops."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
