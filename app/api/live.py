"""Live runs over HTTP (docs/api.md): which there are, and their steps as they come.

A page asks for the steps that it does not have yet, and asks again when it has drawn them: a slow one gets larger
blocks, and neither the filter nor the server keeps anything for it.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from fastapi import APIRouter, HTTPException, WebSocket, WebSocketDisconnect
from fastapi.responses import StreamingResponse

from beliefscope.app.protocol.messages import closing, columns, pictures
from beliefscope.app.runs.live_runs import Absent, LiveRuns, Run, called, described
from beliefscope.app.runs.trace_store import Library
from beliefscope.app.server.security import kept_file
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.strict_json import read_json

BLOCK = 1 << 22  # bytes of the file that one message is made of, at most
LOOK = 0.02  # s between two looks at a file that a page waits for
PATIENCE = 1.0  # s after which a page is told that nothing has come
TAIL = 1 << 18  # bytes of a recording that are sent at once


def block(run: Run, first: int) -> bytes:
    """Steps from ``first`` on, as many as a message should hold.

    Length of the header, JSON header, padding to a multiple of 4, float32 columns, uint8 pictures.
    """
    steps = run.reader.steps
    most = max(1, BLOCK // max(1, run.reader.bytes_per_step))
    part = run.reader.part(min(first, steps), min(first + most, steps))
    said, buffer = columns(part) if len(part) else ([], b"")
    seen = pictures(part)
    head = {
        "first": min(first, steps),
        "steps": len(part),
        "columns": said,
        "pictures": 0 if seen is None else seen.nbytes,
        "of": steps,
        "written": run.reader.path.stat().st_mtime,
        "state": run.state,
        "told": run.told,
    }
    text = json.dumps(head).encode()
    padded = len(text).to_bytes(4, "little") + text + b" " * (-len(text) % 4)
    return padded + buffer + (b"" if seen is None else seen.tobytes())


def routes(library: Library) -> APIRouter:
    """Every route under ``/api/live``."""
    router = APIRouter()
    runs = library.live

    @router.get("/api/live")
    def list_runs() -> dict[str, Any]:
        found: list[dict[str, Any]] = []
        for name in runs.newest():
            try:
                run = runs[name]
                shown, checkpoint = called(run, library.filters(run.task.name))
                lacks_file = isinstance(checkpoint, Absent) and bool(run.like.checkpoint_hash)
                about = {"filter": shown, "here": not lacks_file, "kind": run.like.kind}
                found.append(described(run) | about)
            except BadInput as error:
                found.append({"name": name, "state": "damaged", "told": str(error)})
        tasks = {run["task"] for run in found if "task" in run}
        return {"runs": found, "tasks": [library.described(task) for task in sorted(tasks)]}

    @router.websocket("/api/live/{name}")
    async def follow(websocket: WebSocket, name: str) -> None:
        await websocket.accept()
        try:
            while True:
                first, state = _asked(await websocket.receive_text())
                await websocket.send_bytes(await _next(runs, name, first, state))
        except BadInput as error:
            await websocket.close(4000, closing(str(error)))
        except (WebSocketDisconnect, KeyError):  # KeyError: a binary message, which has no text
            return

    @router.get("/api/live/{name}.rrd")
    async def recording(name: str) -> StreamingResponse:
        run = await asyncio.to_thread(runs.__getitem__, name)
        end = time.monotonic() + PATIENCE  # it begins a moment after the run
        while (path := kept_file(runs.folder, f"{run.name}.rrd")) is None and time.monotonic() < end:
            await asyncio.sleep(LOOK)
        if path is None:
            raise HTTPException(404, f"Live run {name!r} has no recording.")
        return StreamingResponse(_tail(run, path), media_type="application/octet-stream")

    return router


def _asked(text: str) -> tuple[int, str]:
    """From which step on, and the state that the page knows."""
    try:
        message = read_json(text)
        first, state = message["from"], message.get("state", "")
    except (ValueError, TypeError, KeyError, AttributeError):
        raise BadInput('a page asks for steps as {"from": STEP, "state": what it knows}') from None
    if isinstance(first, bool) or not isinstance(first, int) or first < 0:
        raise BadInput(f"steps are asked for from an integer from 0 on, not {first!r}")
    return first, str(state)


async def _next(runs: LiveRuns, name: str, first: int, state: str) -> bytes:
    """The next steps, as soon as there are any or the state is another; an empty block where none come for a while."""
    run = await asyncio.to_thread(runs.__getitem__, name)
    end = time.monotonic() + PATIENCE
    while run.reader.steps <= first and run.state == state and time.monotonic() < end:
        await asyncio.sleep(LOOK)
        if run.stirs:
            await asyncio.to_thread(run.look)
    return await asyncio.to_thread(block, run, first)


async def _tail(run: Run, path: Path) -> AsyncIterator[bytes]:
    """A file as it grows, until its run has ended. Whoever reads slowly is not waited for by anyone."""
    with path.open("rb") as file:
        while True:
            await asyncio.to_thread(run.look)
            ended = run.state != "running"  # before the last read
            while part := await asyncio.to_thread(file.read, TAIL):
                yield part
            if ended:
                return
            await asyncio.sleep(5 * LOOK)
