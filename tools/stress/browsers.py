"""Simulated browser: requests and scrubbing as by the page (view_socket.js), over real HTTP and WebSockets."""

from __future__ import annotations

import asyncio
import contextlib
import importlib.metadata
import json
import time
from collections.abc import Iterable
from typing import Any

import httpx
import websockets.asyncio.client
from websockets.asyncio.client import ClientConnection
from websockets.exceptions import ConnectionClosed
from websockets.typing import Origin, Subprotocol

COARSE, FINE = 41, 135
SCENE = f"viser-v{importlib.metadata.version('viser')}"
RETRY = 0.15  # s between requests for a trace in progress
TIMEOUT = 10.0  # s to wait for an answer
Selection = dict[str, Any]
"""``task``, ``filter``, ``data``, ``episode``, ``faults``."""


class Browser:
    """One page: a view, its socket and that of its scene. One cursor is in flight at a time; the newest is sent next.

    Attributes:
        scrubs: s from a cursor move to its maps. scenes: s to its scene. received: bytes over both sockets.
    """

    def __init__(self, url: str) -> None:
        self.scrubs: list[float] = []
        self.scenes: list[float] = []
        self.received = 0
        self.errors: list[str] = []
        self._url = url.rstrip("/")
        self.http = httpx.AsyncClient(base_url=self._url, headers={"Origin": self._url}, timeout=120.0)
        self._socket: ClientConnection | None = None
        self._scene: ClientConnection | None = None
        self._tasks: list[asyncio.Task[None]] = []
        self._tags: dict[str, str] = {}
        self._serial = 0
        self._in_flight: int | None = None
        self._sent: dict[int, tuple[float, int]] = {}
        self._next: tuple[dict[str, Any], float] | None = None
        self._finished = asyncio.Event()

    async def open(self, scene: bool = True) -> None:
        """Open a new view and its sockets."""
        view = (await self._request("POST", "/api/views")).json()
        self._socket = await self._connect(view["socket"])
        self._tasks = [asyncio.create_task(self._receive(self._socket))]
        if scene:
            await self._request("GET", view["scene"])
            self._scene = await self._connect(view["scene"].rstrip("/"), SCENE)
            self._tasks.append(asyncio.create_task(self._receive_scene(self._scene)))

    async def load(self, selection: Selection) -> int:
        """Load the selected trace with its columns and images; return its number of steps."""
        path, query = trace_path(selection)
        while (answer := await self._request("GET", path, params=query)).status_code == 202:
            await asyncio.sleep(RETRY)
        header = answer.json()
        for part in ("columns", *(["images"] if header["image_size"] else [])):
            tag = self._tags.get(f"{path}/{part}?{query}", "")
            response = await self._request("GET", f"{path}/{part}", params=query, headers={"If-None-Match": tag})
            self._tags[f"{path}/{part}?{query}"] = response.headers["etag"]
        return int(header["steps"])

    async def drag(self, selection: Selection, steps: Iterable[int], rate: float, scene: bool = True) -> None:
        """Move over the steps at a rate per second, then wait for the fine maps and the scene of the last one."""
        start, step = time.perf_counter(), 0
        for count, step in enumerate(steps, start=1):
            self._move({**selection, "step": step, "size": COARSE, "scene": scene})
            await asyncio.sleep(max(0.0, start + count / rate - time.perf_counter()))
        self._finished.clear()
        self._move({**selection, "step": step, "size": FINE, "scene": True})
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._finished.wait(), TIMEOUT)

    async def close(self, vanish: bool = False) -> None:
        """Close the view. vanish: abort the connections, as on a power failure."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for socket in (self._socket, self._scene):
            if socket is not None:
                if vanish:
                    socket.transport.abort()
                else:
                    await socket.close()
        self._socket = self._scene = None
        self._in_flight, self._next, self._sent = None, None, {}

    async def end(self) -> None:
        await self.close()
        await self.http.aclose()

    def _move(self, cursor: dict[str, Any]) -> None:
        self._next = cursor, time.perf_counter()
        self._pump()

    def _pump(self) -> None:
        if self._in_flight is not None and time.perf_counter() - self._sent[self._in_flight][0] < TIMEOUT:
            return
        if self._next is None or self._socket is None:
            return
        (cursor, when), self._next = self._next, None
        self._serial += 1
        self._in_flight = self._serial
        self._sent[self._serial] = when, cursor["size"]
        self._tasks[1 + (self._scene is not None) :] = [
            asyncio.create_task(self._send({"type": "cursor", "serial": self._serial, "angle": None, **cursor}))
        ]

    async def _send(self, message: dict[str, Any]) -> None:
        with contextlib.suppress(ConnectionClosed):
            if self._socket is not None:
                await self._socket.send(json.dumps(message))

    async def _receive(self, socket: ClientConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            async for data in socket:
                now = time.perf_counter()
                self.received += len(data)
                if isinstance(data, bytes):
                    length = int.from_bytes(data[:4], "little")
                    message = json.loads(data[4 : 4 + length])
                else:
                    message = json.loads(data)
                kind, serial = message["type"], message.get("serial")
                when, size = self._sent.get(serial, (now, COARSE))
                if kind in ("maps", "no_maps", "error") and not message.get("other"):
                    if kind == "error":
                        self.errors.append(message["error"])
                    if size == COARSE and kind == "maps":
                        self.scrubs.append(now - when)
                    if serial == self._in_flight:
                        self._in_flight = None
                        self._pump()
                if kind == "drawn":
                    if size == COARSE:
                        self.scenes.append(now - when)
                    elif serial == self._serial:
                        self._finished.set()
                    self._sent = {key: value for key, value in self._sent.items() if key > serial}

    async def _receive_scene(self, socket: ClientConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            async for data in socket:
                self.received += len(data)

    async def _connect(self, path: str, *protocols: str) -> ClientConnection:
        return await websockets.asyncio.client.connect(
            self._url.replace("http", "ws", 1) + path,
            origin=Origin(self._url),
            subprotocols=[Subprotocol(name) for name in protocols] or None,
            compression=None,
            max_size=None,
            proxy=None,
        )

    async def _request(self, method: str, path: str, **options: Any) -> httpx.Response:
        answer = await self.http.request(method, path, **options)
        if answer.status_code >= 400:
            raise RuntimeError(f"{method} {path}: {answer.status_code} {answer.text[:200]}")
        return answer


def trace_path(selection: Selection) -> tuple[str, dict[str, str]]:
    """Path and query of the trace of a selection."""
    query = {"faults": selection["faults"], "data": selection["data"]}
    return f"/api/trace/{selection['task']}/{selection['filter']}/{selection['episode']}", query
