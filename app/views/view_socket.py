"""View: the cursor and 3D scene of one page, and the socket that connects them."""

import asyncio
import contextlib
import logging
import secrets
import time
from collections.abc import AsyncIterator, Callable
from functools import partial
from typing import Any

from pydantic import ValidationError
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketDisconnected

from beliefscope.app.protocol.map_format import EncodedMaps
from beliefscope.app.protocol.messages import (
    VIEW_MESSAGE,
    Cursor,
    MoveViewpoint,
    SceneLayers,
    Theme,
    describe_error,
)
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.runs.traced_run import TracedRun
from beliefscope.app.views.scene import Scene
from beliefscope.app.views.scheduler import DeadlineExecutor, held_with_pause
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.inspect.maps.map_engine import COARSE, FINE

log = logging.getLogger("beliefscope.app")
# Deadlines in s: coarse maps, which follow a moving cursor, come first.
COARSE_DEADLINE, SCENE_DEADLINE, FINE_DEADLINE, PREFETCH_DEADLINE = 0.0, 0.25, 0.5, 5.0
PREFETCH_STEPS = 200  # around the cursor
PREFETCH_DELAY = 0.4  # s without a new cursor


class View:
    """One page's cursor and scene.

    The page may move its cursor faster than it can be drawn: only the newest cursor waits, and the ones it replaces are
    not answered. Each processed cursor is answered with maps, then waits for the scene. There, too, only the newest one
    waits, so that a slow scene does not delay maps.

    name: random part of its addresses. idle_since: monotonic time at which its page disconnected; None while connected.
    """

    def __init__(self, store: TraceStore, executor: DeadlineExecutor, scene_lock: asyncio.Lock, dark: bool) -> None:
        """Start the scene's server, which blocks for about 50 ms. scene_lock: held while a scene is drawn."""
        self.name = secrets.token_urlsafe(12)
        self.scene = Scene(dark)
        self.idle_since: float | None = time.monotonic()
        self._store = store
        self._executor = executor
        self._scene_lock = scene_lock
        self._newest: Cursor | None = None
        self._cursor_arrived = asyncio.Event()
        self._current: tuple[Selection, TracedRun] | None = None  # keeps the run in memory
        self._scene_update: tuple[Cursor, Callable[[], None]] | None = None  # that the scene is about to show
        self._scene_outdated = asyncio.Event()
        self._prefetch_center: tuple[Cursor, TracedRun] | None = None
        self._maps_sent = asyncio.Event()
        self._socket: WebSocket | None = None

    async def serve(self, websocket: WebSocket) -> None:
        """Serve the page's socket until it closes. A second page on the same view replaces the first."""
        await websocket.accept()
        previous, self._socket = self._socket, websocket
        self.idle_since = None
        if previous is not None:
            await _ignore_disconnect(previous.close(4000, "The view was opened by another page."))
        loops = (self._answer_cursors(websocket), self._update_scene(websocket), self._prefetch_maps())
        tasks = [asyncio.create_task(loop) for loop in loops]
        try:
            while True:
                await self._receive(websocket, await websocket.receive_text())
        # WebSocketDisconnected: during a send. KeyError: a binary message, which has no text.
        except (WebSocketDisconnect, WebSocketDisconnected, KeyError):
            await _ignore_disconnect(websocket.close(1003))
        finally:
            for task in tasks:
                task.cancel()
            self._prefetch_center = None
            if self._socket is websocket:
                self._socket, self.idle_since = None, time.monotonic()

    async def _receive(self, websocket: WebSocket, text: str) -> None:
        try:
            match message := VIEW_MESSAGE.validate_json(text):
                case Cursor():
                    self._newest = message
                    self._cursor_arrived.set()
                case SceneLayers():
                    await asyncio.to_thread(self.scene.set_layers, message)
                case MoveViewpoint():
                    await asyncio.to_thread(self.scene.set_viewpoint, message.at)
                case Theme():
                    await asyncio.to_thread(self.scene.set_dark, message.dark)
        except ValidationError as error:
            serial = None
            with contextlib.suppress(ValueError, AttributeError):  # not JSON, or not an object
                serial = read_json(text).get("serial")
            await _send_error(websocket, serial, f"{describe_error(error)}.")

    async def _answer_cursors(self, websocket: WebSocket) -> None:
        while True:
            await self._cursor_arrived.wait()
            self._cursor_arrived.clear()
            cursor = self._newest
            assert cursor is not None
            async with self._errors_sent(websocket, cursor.serial):
                await self._answer(websocket, cursor)

    async def _answer(self, websocket: WebSocket, cursor: Cursor) -> None:
        selection = Selection(cursor.task, cursor.filter, cursor.episode, cursor.faults, cursor.data)
        run = await self._request_run(selection)
        if not run.growing and not await self._complete_before_newer_cursor(run):
            return
        self._current = selection, run
        if cursor.step >= len(run):
            raise BadInput(f"step {cursor.step} does not exist. Available: 0 to {len(run) - 1}.")
        comparison = self._comparison(selection, cursor.against, len(run))
        maps = None
        if reason := await asyncio.to_thread(run.no_maps_at, cursor.step):
            message = {"type": "no_maps", "serial": cursor.serial, "step": cursor.step, "reason": reason}
            await websocket.send_json(message)
        else:
            if cursor.comparison_maps and comparison is not None and not comparison.no_maps_at(cursor.step):
                other = await self._maps(cursor, comparison)
                await websocket.send_bytes(other.message(cursor.serial, other=True))
            encoded = await self._maps(cursor, run)
            await websocket.send_bytes(encoded.message(cursor.serial))
            maps = encoded.maps if encoded.on_floor else None  # the floor of the scene shows positions only
            if not run.growing:
                self._prefetch_center = cursor, run
                self._maps_sent.set()
        if cursor.scene:
            trace = None if comparison is None else comparison.trace
            self._scene_update = cursor, partial(self.scene.show, run, cursor.step, trace, maps)
            self._scene_outdated.set()

    async def _update_scene(self, websocket: WebSocket) -> None:
        """Move the scene to the newest cursor whose maps were sent.

        Scenes are drawn one at a time with pauses, because several at once would hold Python's lock and delay maps.
        """
        while True:
            await self._scene_outdated.wait()
            self._scene_outdated.clear()
            if self._scene_update is None:
                continue
            async with self._errors_sent(websocket, self._scene_update[0].serial):
                async with held_with_pause(self._scene_lock):
                    update, self._scene_update = self._scene_update, None  # may have been replaced by a newer one
                    if update is None:
                        continue
                    cursor, show = update
                    await self._executor.run(show, SCENE_DEADLINE)
                await websocket.send_json({"type": "drawn", "serial": cursor.serial, "step": cursor.step})

    async def _prefetch_maps(self) -> None:
        """Compute the coarse maps around the cursor while it does not move."""
        while True:
            await self._maps_sent.wait()
            while self._maps_sent.is_set():
                self._maps_sent.clear()
                await asyncio.sleep(PREFETCH_DELAY)
            if self._prefetch_center is None:
                continue
            cursor, run = self._prefetch_center
            with contextlib.suppress(Exception):  # reported when the page requests the step
                for step in run.missing_maps(cursor.step, PREFETCH_STEPS, cursor.map_options):
                    compute = partial(run.encoded_maps, step, COARSE, cursor.map_options)
                    await self._executor.run(compute, PREFETCH_DEADLINE, frozenset({run, COARSE}))
                    if self._maps_sent.is_set():
                        break

    async def _maps(self, cursor: Cursor, run: TracedRun) -> EncodedMaps:
        compute = partial(run.encoded_maps, cursor.step, cursor.size, cursor.map_options)
        if cursor.size == FINE:  # one at a time, so that threads remain available for coarse maps
            return await self._executor.run(compute, FINE_DEADLINE, frozenset({run, FINE}))
        return await self._executor.run(compute, COARSE_DEADLINE, frozenset({run}))

    async def _request_run(self, selection: Selection) -> TracedRun:
        if self._current is not None and self._current[0] == selection and not self._current[1].growing:
            return self._current[1]
        return await asyncio.to_thread(self._store.request, selection)

    @contextlib.asynccontextmanager
    async def _errors_sent(self, websocket: WebSocket, serial: int) -> AsyncIterator[None]:
        """Send errors to the page as the answer to its cursor."""
        try:
            yield
        except BadInput as error:
            await _send_error(websocket, serial, str(error))
        except Exception as error:
            gone = isinstance(error, WebSocketDisconnect)  # the page was closed
            if gone or (websocket is not self._socket and isinstance(error, RuntimeError)):
                return
            log.exception("The cursor could not be drawn")
            await _send_error(websocket, serial, f"The server failed: {error}")

    def _comparison(self, selection: Selection, against: str, steps: int) -> TracedRun | None:
        """The comparison run, once it is complete. The page requests its computation and learns of errors over HTTP."""
        with contextlib.suppress(BadInput):
            run = self._store.cached(selection.comparison(against)) if against else None
            return run if run is not None and len(run.trace) == steps else None
        return None

    async def _complete_before_newer_cursor(self, run: TracedRun) -> bool:
        """Wait for the trace or a newer cursor; return whether the trace is complete. Raises errors of the trace."""
        complete: asyncio.Future[Any] = asyncio.wrap_future(run.future)
        newer: asyncio.Future[Any] = asyncio.ensure_future(self._cursor_arrived.wait())
        try:
            await asyncio.wait({complete, newer}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            newer.cancel()
        if complete.done():
            complete.result()
        return complete.done()


async def _ignore_disconnect(sending: Any) -> None:
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        await sending


async def _send_error(websocket: WebSocket, serial: Any, error: str) -> None:
    await _ignore_disconnect(websocket.send_json({"type": "error", "serial": serial, "error": error}))
