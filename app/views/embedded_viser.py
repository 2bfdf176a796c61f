"""A viser server without its own port, reached through WebSockets of this server.

viser opens a port on every interface and answers any Host and Origin. This module captures viser's socket handler
during construction, so that no port is opened, and connects it to Starlette WebSockets behind our security middleware.
It depends on viser's internals (the version is pinned); ``EmbeddedViser`` raises an error if they have changed.
"""

import asyncio
import contextlib
import importlib.util
import logging
import sys
import threading
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import rich
import viser
import viser.infra
import websockets.asyncio.server
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.exceptions import ConnectionClosedOK

MAX_CLIENTS = 4  # per scene; a page has one, and a second one only until a lost connection is detected
ACCEPTED_MESSAGES = frozenset({viser._messages.GuiUpdateMessage})
"""Messages with a server-wide handler; camera messages are handled per connection.

viser's other handlers would share the scene over the Internet and store uploaded files.
"""
CLIENT_PAGE = Path(viser.__file__).parent / "client" / "build" / "index.html"
if importlib.util.find_spec("cv2") is None:
    # viser tries to import OpenCV for every image; the failing search takes half of the time of an image update.
    sys.modules["cv2"] = None  # type: ignore[assignment]
log = logging.getLogger("beliefscope.app")
# Construction and stop modify state of the whole process.
_process_lock = threading.Lock()


CLIENT_HEAD = """<style>
:root { color-scheme: light dark !important }
[data-floating-window] { display: none !important; }
body, div:has(> div > div > div > canvas) { background: none !important; }
</style><script src="/static/scene/viser_frame_throttle.js"></script>"""
"""Hides viser's control panel, as the page has the controls of the scene, and its background, which is almost black in
the dark theme: the page's is behind it. A frame whose colour scheme differs from the page's would be opaque: white
until viser has its theme. The script precedes viser's own, and sets the scheme of a page whose theme is not that of the
system."""


def client_page() -> bytes:
    """viser's client page with ``CLIENT_HEAD``. Raises RuntimeError if the page has no head."""
    before, head, after = CLIENT_PAGE.read_bytes().partition(b"<head>")
    if not head:
        raise RuntimeError(f"the client page of viser {viser.__version__} has no <head>")
    return before + head + CLIENT_HEAD.encode() + after


class _Connection:
    """The part of websockets' ``ServerConnection`` that viser's handler uses, for one client.

    Runs in viser's event loop; the client's WebSocket runs in the server's. Waiting for it applies backpressure in both
    directions. ``recv`` and ``send`` raise ConnectionClosedOK once the client has gone.
    """

    def __init__(self, websocket: WebSocket, subprotocol: str, server_loop: asyncio.AbstractEventLoop) -> None:
        self.subprotocol = subprotocol
        self._websocket = websocket
        self._server_loop = server_loop

    async def recv(self) -> bytes:
        message: bytes = await self._run_in_server_loop(self._websocket.receive_bytes())
        return message

    async def send(self, message: bytes) -> None:
        await self._run_in_server_loop(self._websocket.send_bytes(message))

    async def close(self, code: int = 1000, reason: str = "") -> None:
        with contextlib.suppress(ConnectionClosedOK):
            await self._run_in_server_loop(self._websocket.close(code, reason))

    async def _run_in_server_loop(self, coroutine: Any) -> Any:
        try:
            return await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(coroutine, self._server_loop))
        except (WebSocketDisconnect, RuntimeError, KeyError) as error:  # KeyError: a text message, which has no bytes
            raise ConnectionClosedOK(None, None) from error


Handler = Callable[[_Connection], Awaitable[None]]


class EmbeddedViser:
    """One viser server, reachable only through ``connect``.

    server: the public viser API: ``scene``, ``gui``, ``flush()``. Raises RuntimeError if the installed viser starts its
    socket server differently.
    """

    def __init__(self) -> None:
        with _process_lock, _silence(), _captured_handler() as captured:
            self.server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        if len(captured) != 1:
            self.server.stop()
            raise RuntimeError(
                f"viser {viser.__version__} does not start its socket server through websockets.asyncio.server.serve; "
                "app/views/embedded_viser.py was written for viser 1.1."
            )
        handlers = self.server._websock_server._incoming_handlers
        for message in handlers.keys() - ACCEPTED_MESSAGES:
            self.server._websock_server.unregister_handler(message)
        if handlers.keys() != ACCEPTED_MESSAGES:
            self.server.stop()
            raise RuntimeError(f"viser {viser.__version__} has other message handlers than embedded_viser.py expects.")
        self._handler: Handler = captured[0]
        self._loop = self.server.get_event_loop()
        self._clients: list[Future[None]] = []  # the running handler of each, ordered by age

    @property
    def subprotocol(self) -> str:
        """WebSocket subprotocol of this version's client."""
        return f"viser-v{viser.__version__}"

    async def connect(self, websocket: WebSocket) -> None:
        """Serve a client until it, or ``close``, ends the connection. Rejects clients of other viser versions."""
        if self.subprotocol not in websocket.scope["subprotocols"]:
            await websocket.accept()
            await websocket.close(1002, f"This scene requires {self.subprotocol}.")
            return
        await websocket.accept(subprotocol=self.subprotocol)
        connection = _Connection(websocket, self.subprotocol, asyncio.get_running_loop())
        handling = asyncio.run_coroutine_threadsafe(self._handle(connection), self._loop)
        self._clients.append(handling)
        for oldest in self._clients[:-MAX_CLIENTS]:
            oldest.cancel()
        try:
            await asyncio.wait({asyncio.wrap_future(handling)})
        finally:
            handling.cancel()
            self._clients.remove(handling)
            with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                await websocket.close()

    async def _handle(self, connection: _Connection) -> None:
        try:
            await self._handler(connection)
        except Exception as error:  # raised by viser for an invalid message
            log.debug("Closing the connection of a scene: %s", error)

    def close(self) -> None:
        """End all connections and viser's threads. Blocks for up to a few seconds."""
        for client in tuple(self._clients):
            client.cancel()
        with _process_lock, _silence():
            self.server.stop()


@contextlib.contextmanager
def _captured_handler() -> Iterator[list[Handler]]:
    """Replace ``websockets.asyncio.server.serve``: collect viser's handlers in the list and open no port."""
    original = websockets.asyncio.server.serve
    captured: list[Handler] = []

    @contextlib.asynccontextmanager
    async def no_listener(handler: Handler) -> Any:
        captured.append(handler)
        yield SimpleNamespace(server=SimpleNamespace(sockets=()))
        # Let the connections' handlers end before viser closes its loop, as the original server does.
        others = asyncio.all_tasks() - {asyncio.current_task()}
        if others:
            _, late = await asyncio.wait(others, timeout=1.0)
            for task in late:
                task.cancel()
            await asyncio.gather(*late, return_exceptions=True)

    def serve(handler: Any, *args: Any, **kwargs: Any) -> Any:
        if getattr(handler, "__module__", "") == viser.infra.WebsockServer.__module__:
            return no_listener(handler)
        return original(handler, *args, **kwargs)

    websockets.asyncio.server.serve = serve  # type: ignore[assignment, misc]
    try:
        yield captured
    finally:
        websockets.asyncio.server.serve = original  # type: ignore[misc]


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Suppress viser's console output, which names a port that is not open."""
    console = rich.get_console()
    quiet, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = quiet
