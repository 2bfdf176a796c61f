"""Views: one browser's own cursor and 3D scene, and the socket on which the two sides tell each other."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketDisconnected

from beliefscope.app.protocol.map_format import WiredMaps
from beliefscope.app.protocol.messages import Cursor, cursor, look, viewpoint
from beliefscope.app.runs.selection import COARSE, FINE
from beliefscope.app.runs.trace_store import Library, Selection, Traced
from beliefscope.app.views.memory import give_back
from beliefscope.app.views.scene import Scene
from beliefscope.app.views.scheduler import Desk, Turns
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.inspect.likelihood import LikelihoodMap
from beliefscope.inspect.trace import Trace

log = logging.getLogger("beliefscope.app")
COARSE_DUE, SCENE_DUE, FINE_DUE = 0.0, 0.25, 0.5  # s: where many scrub, maps under moving hands before all else
AHEAD_DUE, AHEAD, PAUSE = 5.0, 200, 0.4  # s; steps about the cursor; s that a hand has rested before they are made


@dataclass(frozen=True)
class _Drawing:
    """What a scene is to show."""

    wanted: Cursor
    traced: Traced
    other: Trace | None
    maps: LikelihoodMap | None


class View:
    """One page's scene, and the newest cursor it sent.

    The page owns the cursor and may move it faster than it can be drawn: a cursor waits in one place, where a newer one
    takes its place unanswered. Each that is taken up is answered with maps; then it waits for the scene, in one place
    too, so that slow scenes hold up no maps.

    Attributes:
        name: unguessable; part of the view's addresses. idle_since: monotonic s when its page went, None while there.
    """

    def __init__(self, library: Library, desk: Desk, turns: Turns, dark: bool) -> None:
        """Turns: of all views, to draw a scene. Blocks for some 50 ms while the scene's server starts."""
        self.name = secrets.token_urlsafe(12)
        self.scene = Scene(self._moved_in_scene, dark)
        self.idle_since: float | None = time.monotonic()
        self._library = library
        self._desk = desk
        self._turns = turns
        self._waiting: Cursor | None = None
        self._arrived = asyncio.Event()
        self._shown: tuple[Selection, Traced] | None = None  # in memory for as long as somebody looks at it
        self._drawing: _Drawing | None = None
        self._looked = asyncio.Event()
        self._last: tuple[Cursor, Traced] | None = None
        self._answered = asyncio.Event()
        self._moved_to: int | None = None
        self._telling = asyncio.Lock()
        self._socket: WebSocket | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    async def attend(self, websocket: WebSocket) -> None:
        """Serve the page's socket until it closes. A second page on the same view takes the first one's place."""
        await websocket.accept()
        before, self._socket = self._socket, websocket
        self._loop, self.idle_since = asyncio.get_running_loop(), None
        if before is not None:
            await _quietly(before.close(4000, "The view was opened by another page."))
        answering = [asyncio.create_task(each(websocket)) for each in (self._answer, self._draw, self._prepare)]
        try:
            while True:
                await self._heard(websocket, await websocket.receive_text())
        # The second: it went while it was told something. KeyError: a binary message, which has no text.
        except (WebSocketDisconnect, WebSocketDisconnected, KeyError):
            await _quietly(websocket.close(1003))
        finally:
            for task in answering:
                task.cancel()
            self._last = None
            if self._socket is websocket:
                self._socket, self.idle_since = None, time.monotonic()

    async def _heard(self, websocket: WebSocket, text: str) -> None:
        serial = None
        try:
            message = read_json(text)
            if not isinstance(message, dict):
                raise BadInput("A message is a JSON object.")
            serial = message.get("serial")
            match message.get("type"):
                case "cursor":
                    self._waiting = cursor(message)
                    self._arrived.set()
                case "theme":
                    await asyncio.to_thread(self.scene.set_dark, message.get("dark") is True)
                case "look":
                    await asyncio.to_thread(self.scene.look, look(message))
                case "stand":
                    await asyncio.to_thread(self.scene.stand, viewpoint(message))
                case other:
                    raise BadInput(f"Message type {other!r} does not exist. Available: cursor, look, stand, theme.")
        except BadInput as error:
            await _tell_error(websocket, serial, str(error))
        except ValueError as error:
            await _tell_error(websocket, serial, f"Not JSON: {error}.")

    async def _answer(self, websocket: WebSocket) -> None:
        while True:
            await self._arrived.wait()
            self._arrived.clear()
            wanted = self._waiting
            assert wanted is not None
            async with self._told(websocket, wanted.serial):
                await self._answer_one(websocket, wanted)

    async def _answer_one(self, websocket: WebSocket, wanted: Cursor) -> None:
        selection = Selection(wanted.task, wanted.filter, wanted.episode, wanted.faults, wanted.data)
        traced = await self._traced(selection)
        if not traced.grows and not await self._ready_before_newer(traced):
            return
        self._shown = selection, traced
        if wanted.step >= len(traced):
            raise BadInput(f"step {wanted.step} does not exist. Available: 0 to {len(traced) - 1}.")
        other = self._other(selection, wanted.against, len(traced))
        maps = None
        if traced.no_maps:
            await websocket.send_json({"type": "no_maps", "serial": wanted.serial, "step": wanted.step})
        else:
            if wanted.beside and other is not None and not other.no_maps:
                beside = await self._maps(wanted, other)
                await websocket.send_bytes(beside.message(wanted.serial, other=True))
            wired = await self._maps(wanted, traced)
            await websocket.send_bytes(wired.message(wanted.serial))
            maps = wired.maps
            if not traced.grows:
                self._last = wanted, traced
                self._looked.set()
        if wanted.scene:
            self._drawing = _Drawing(wanted, traced, None if other is None else other.trace, maps)
            self._answered.set()

    async def _draw(self, websocket: WebSocket) -> None:
        """Moves the scene to the newest cursor whose maps are sent.

        One scene at a time in their turn, with rests between: many of them hold Python's lock so long that maps wait.
        """
        while True:
            await self._answered.wait()
            self._answered.clear()
            if self._drawing is None:
                continue
            async with self._told(websocket, self._drawing.wanted.serial):
                async with self._turns:
                    drawing, self._drawing = self._drawing, None  # by now maybe a newer one
                    if drawing is None:
                        continue
                    step, serial = drawing.wanted.step, drawing.wanted.serial
                    await self._desk.do(
                        partial(self.scene.show, drawing.traced, step, drawing.other, drawing.maps), SCENE_DUE
                    )
                await websocket.send_json({"type": "drawn", "serial": serial, "step": step})

    async def _prepare(self, _: WebSocket) -> None:
        """Makes the coarse maps about the cursor while a hand rests, so that they are there when it moves."""
        while True:
            await self._looked.wait()
            while self._looked.is_set():
                self._looked.clear()
                await asyncio.sleep(PAUSE)
            if self._last is None:
                continue
            wanted, traced = self._last
            with contextlib.suppress(Exception):  # what goes wrong is told to whom it matters: who looks there
                for step in traced.unmade(wanted.step, wanted.angle, AHEAD):
                    make = partial(traced.wired, step, wanted.angle, COARSE)
                    await self._desk.do(make, AHEAD_DUE, frozenset({traced, COARSE}))
                    if self._looked.is_set():
                        break

    async def _maps(self, wanted: Cursor, traced: Traced) -> WiredMaps:
        make = partial(traced.wired, wanted.step, wanted.angle, wanted.size)
        if wanted.size == FINE:  # one at a time, lest nobody be left for those that are made quickly
            return await self._desk.do(make, FINE_DUE, frozenset({traced, FINE}))
        return await self._desk.do(make, COARSE_DUE, frozenset({traced}))

    async def _traced(self, selection: Selection) -> Traced:
        if self._shown is not None and self._shown[0] == selection and not self._shown[1].grows:
            return self._shown[1]
        return await asyncio.to_thread(self._library.traced, selection)

    @contextlib.asynccontextmanager
    async def _told(self, websocket: WebSocket, serial: int) -> AsyncIterator[None]:
        """What goes wrong with a cursor is told to its page."""
        try:
            yield
        except BadInput as error:
            await _tell_error(websocket, serial, str(error))
        except Exception as error:
            if websocket is not self._socket and isinstance(error, WebSocketDisconnect | RuntimeError):
                return
            log.exception("The cursor could not be drawn")
            await _tell_error(websocket, serial, f"The server failed: {error}")

    def _other(self, selection: Selection, against: str, steps: int) -> Traced | None:
        """The other run, once it is there: the page has it computed over HTTP, and is told there what is wrong."""
        with contextlib.suppress(BadInput):
            other = self._library.there(selection.against(against)) if against else None
            return other if other is not None and len(other.trace) == steps else None
        return None

    async def _ready_before_newer(self, traced: Traced) -> bool:
        """Wait for the trace, but no longer than until a newer cursor comes. Raises what computing it raised."""
        ready: asyncio.Future[Any] = asyncio.wrap_future(traced.done)
        newer: asyncio.Future[Any] = asyncio.ensure_future(self._arrived.wait())
        try:
            await asyncio.wait({ready, newer}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            newer.cancel()
        if ready.done():
            ready.result()
        return ready.done()

    def _moved_in_scene(self, step: int) -> None:
        """Called in threads of viser's. Of steps that come faster than the page takes them, it is told the newest."""
        waiting, self._moved_to = self._moved_to is not None, step
        if not waiting and self._loop is not None and not self._loop.is_closed():
            asyncio.run_coroutine_threadsafe(self._tell_moved(), self._loop)

    async def _tell_moved(self) -> None:
        async with self._telling:
            step, self._moved_to = self._moved_to, None
            if step is not None and self._socket is not None:
                await _quietly(self._socket.send_json({"type": "cursor", "step": step, "origin": "scene"}))


class Views:
    """The open views, a bounded number of them.

    Args:
        limit: most views at a time: each is a thread, and some MB (docs/reliability.md).
        patience: s that a view outlives its page, to allow for a lost connection.
    """

    def __init__(self, library: Library, limit: int = 32, patience: float = 30.0) -> None:
        self._library = library
        self._desk = Desk()
        self._turns = Turns()
        self._limit = limit
        self._patience = patience
        self._views: dict[str, View] = {}
        self._opening = asyncio.Lock()

    def __len__(self) -> int:
        return len(self._views)

    def late(self) -> float:
        """s that the maps and scenes which pages wait for are late, at most."""
        return self._desk.late()

    def __getitem__(self, name: str) -> View:
        """Raises KeyError for a view that is not, or no longer, open."""
        return self._views[name]

    async def open(self, dark: bool) -> View:
        """A new view. Closes the one that has been idle longest if there are too many; BadInput if all are in use."""
        async with self._opening:
            await self._close_idle(keep=self._limit - 1)
            if len(self._views) >= self._limit:
                raise BadInput(
                    f"As many pages are open already as this server shows at a time, {self._limit}; close one and "
                    "reload, or serve with more --views."
                )
            view = await asyncio.to_thread(View, self._library, self._desk, self._turns, dark)
            self._views[view.name] = view
            return view

    async def tidy(self) -> None:
        """Close views whose page has gone for longer than the patience. Runs until cancelled."""
        while True:
            await asyncio.sleep(self._patience / 4)
            await self._close_idle(keep=0, idle_for=self._patience)

    async def _close_idle(self, keep: int, idle_for: float = 0.0) -> None:
        before = time.monotonic() - idle_for
        idle = [v for v in self._views.values() if v.idle_since is not None and v.idle_since <= before]
        idle.sort(key=lambda v: v.idle_since or 0.0)
        closing = idle[: max(0, len(self._views) - keep)]
        for view in closing:  # at once: meanwhile others close some, or a page comes to one
            del self._views[view.name]
        for view in closing:
            await asyncio.to_thread(view.scene.close)
        if idle:
            await asyncio.to_thread(give_back)

    async def close(self) -> None:
        """Close every view and its threads."""
        views, self._views = list(self._views.values()), {}
        await asyncio.to_thread(self._desk.close)
        await asyncio.gather(*(asyncio.to_thread(view.scene.close) for view in views))


async def _quietly(sending: Any) -> None:
    """Await something sent to a socket that may have gone."""
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        await sending


async def _tell_error(websocket: WebSocket, serial: Any, error: str) -> None:
    await _quietly(websocket.send_json({"type": "error", "serial": serial, "error": error}))
