"""Routes under ``/api/live``: the list of live runs, their steps and their recordings.

A page requests the steps it does not have and the next ones once it has drawn them; slow pages get larger blocks.
Neither the filter nor the server buffers anything for a page.
"""

import asyncio
import json
import time
from collections.abc import AsyncIterator
from itertools import repeat
from pathlib import Path
from typing import Any

from fastapi import FastAPI, WebSocket, WebSocketDisconnect
from fastapi.responses import Response, StreamingResponse
from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, ValidationError

from beliefscope.app.api.models import LiveList
from beliefscope.app.protocol.errors import NotFound
from beliefscope.app.protocol.messages import close_reason, describe_error
from beliefscope.app.protocol.trace_format import columns
from beliefscope.app.runs.live_runs import LiveRuns, describe, resolve_filter
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.workspace.paths import file_within
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task
from beliefscope.datasets.task_json import difference
from beliefscope.filters.external.unavailable import UnavailableFilter
from beliefscope.inspect.traces.live_run import LiveRun
from beliefscope.inspect.traces.sensors import camera_images
from beliefscope.recordings.open_trace import with_wraps

MAX_BLOCK = 1 << 22  # bytes of the run's file per message
POLL_INTERVAL = 0.02  # s between checks of a file
TIMEOUT = 1.0  # s after which a block without steps is sent
CHUNK = 1 << 18  # bytes of a recording per read


class StepsRequest(BaseModel):
    """Message of the page: the first step it does not have, and the last state it received."""

    model_config = ConfigDict(strict=True)
    first: NonNegativeInt = Field(alias="from")
    state: str = ""


def block(run: LiveRun, first: int) -> bytes:
    """Steps from ``first`` on, limited by ``MAX_BLOCK``.

    Header length, JSON header, padding to a multiple of 4, float32 columns, uint8 images.
    """
    steps = run.reader.steps
    limit = max(1, MAX_BLOCK // max(1, run.reader.bytes_per_step))
    part = run.reader.part(min(first, steps), min(first + limit, steps))
    descriptions, buffer = columns(part) if len(part) else ([], b"")
    images = camera_images(part)
    header = {
        "first": min(first, steps),
        "steps": len(part),
        "columns": descriptions,
        "image_bytes": 0 if images is None else images.nbytes,
        "total": steps,
        "written": run.reader.path.stat().st_mtime,
        "state": run.state,
        "message": run.message,
    }
    text = json.dumps(header).encode()
    padded = len(text).to_bytes(4, "little") + text + b" " * (-len(text) % 4)
    return padded + buffer + (b"" if images is None else images.tobytes())


def add_routes(app: FastAPI, store: TraceStore) -> None:
    runs = store.live

    @app.get("/api/live", response_model=LiveList)
    def list_runs() -> dict[str, Any]:
        entries: list[dict[str, Any]] = []
        tasks: dict[str, Task] = {}
        for name in runs.newest():
            try:
                run = runs[name]
                filter_name, checkpoint = resolve_filter(run, store.filters_of(run))
                unavailable = isinstance(checkpoint, UnavailableFilter) and bool(run.template.checkpoint_hash)
                entry = {"filter": filter_name, "available": not unavailable, "kind": run.template.kind}
                if other := difference(_unwrapped(tasks.setdefault(run.task.name, run.task)), _unwrapped(run.task)):
                    raise BadInput(f"live run {name!r} has {other}, unlike a newer run")
                entries.append(describe(run) | entry)
            except BadInput as error:
                entries.append({"name": name, "state": "damaged", "message": str(error)})
        return {"runs": entries, "tasks": [store.describe_task(tasks[name]) for name in sorted(tasks)]}

    @app.websocket("/api/live/{name}")
    async def follow(websocket: WebSocket, name: str) -> None:
        await websocket.accept()
        try:
            while True:
                request = StepsRequest.model_validate_json(await websocket.receive_text())
                await websocket.send_bytes(await _next_block(runs, name, request))
        except ValidationError as error:
            await websocket.close(4000, close_reason(f"invalid request for steps: {describe_error(error)}"))
        except BadInput as error:
            await websocket.close(4000, close_reason(str(error)))
        except (WebSocketDisconnect, KeyError):  # KeyError: a binary message
            return

    @app.get("/api/live/{name}.rrd", response_class=Response)
    async def recording(name: str) -> StreamingResponse:
        run = await asyncio.to_thread(runs.__getitem__, name)
        end = time.monotonic() + TIMEOUT  # the recording is created shortly after the run
        while (path := file_within(runs.folder, f"{run.name}.rrd")) is None and time.monotonic() < end:
            await asyncio.sleep(POLL_INTERVAL)
        if path is None:
            raise NotFound(f"Live run {name!r} has no recording.")
        return StreamingResponse(_follow_file(run, path), media_type="application/octet-stream")


def _unwrapped(task: Task) -> Task:
    """The task without marks of angles that wrap, which a log shows only if its values span more than half a turn."""
    return with_wraps(task, repeat(False))


async def _next_block(runs: LiveRuns, name: str, request: StepsRequest) -> bytes:
    """The requested steps as soon as one exists or the state changes; an empty block after the timeout."""
    run = await asyncio.to_thread(runs.__getitem__, name)
    end = time.monotonic() + TIMEOUT
    while run.reader.steps <= request.first and run.state == request.state and time.monotonic() < end:
        await asyncio.sleep(POLL_INTERVAL)
        if run.may_have_grown:
            await asyncio.to_thread(run.poll)
    return await asyncio.to_thread(block, run, request.first)


async def _follow_file(run: LiveRun, path: Path) -> AsyncIterator[bytes]:
    """The content of a growing file until its run has ended."""
    with path.open("rb") as file:
        while True:
            await asyncio.to_thread(run.poll)
            ended = run.state != "running"  # before the last read
            while chunk := await asyncio.to_thread(file.read, CHUNK):
                yield chunk
            if ended:
                return
            await asyncio.sleep(5 * POLL_INTERVAL)
