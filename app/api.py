"""The page's interface (docs/api.md): catalog, traces, recordings, views."""

from __future__ import annotations

import hashlib
import re
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote

from fastapi import APIRouter, Body, Depends, HTTPException, Request, WebSocket
from fastapi.responses import FileResponse, JSONResponse, Response
from pydantic import BaseModel, ConfigDict, Field

from beliefscope import __version__
from beliefscope.app.library import Library, Selection, Traced
from beliefscope.app.proxy import client_page
from beliefscope.app.session import Views
from beliefscope.app.wire import pictures
from beliefscope.datasets.catalog import TASKS
from beliefscope.datasets.corrupt import Recipe, described
from beliefscope.inspect.catalog import quick
from beliefscope.inspect.likelihood import no_maps
from beliefscope.recordings.write import write_recording

RECORDING = re.compile(r"(?P<task>.+)-(?P<filter>.+)-episode(?P<episode>\d+)-[0-9a-f]{8}")
PATIENCE = 0.25  # s that a request for a trace waits before it says how far the trace is


class RecordingRequest(BaseModel):
    """Body of ``POST /api/recordings``; maps at every ``maps``-th step, none for 0."""

    model_config = ConfigDict(extra="forbid", strict=True)
    task: str
    filter: str
    episode: int
    recipe: str = ""
    data: str = ""
    maps: Annotated[int, Field(ge=0)] = 0


class ViewRequest(BaseModel):
    """Body of ``POST /api/views``."""

    model_config = ConfigDict(extra="forbid", strict=True)
    dark: bool = False


def _selection(task: str, filter: str, episode: int, recipe: str = "", data: str = "") -> Selection:
    return Selection(task, filter, episode, Recipe.parse(recipe), data)


Asked = Annotated[Selection, Depends(_selection)]
"""What a path and its query name."""


def _of_two(asked: Asked, against: str = "") -> Selection:
    return asked.against(against) if against else asked


OfTwo = Annotated[Selection, Depends(_of_two)]
"""The same, or the other run that it is compared with, where ``against`` says what differs."""


def routes(library: Library, views: Views) -> APIRouter:
    """Every route under ``/api``, ``/scene`` and ``/healthz``. What blocks runs in worker threads (plain ``def``)."""
    router = APIRouter()
    recordings = library.settings.workspace / "recordings"
    writing = threading.Lock()
    scene = client_page("/static/frame.js")
    scene_tag = hashlib.sha256(scene).hexdigest()[:24]

    @router.get("/healthz")
    async def health() -> dict[str, str]:
        return {"status": "ok", "version": __version__}

    @router.get("/api/catalog")
    def catalog() -> dict[str, Any]:
        return {"version": __version__, "faults": described(), **library.catalog()}

    @router.get("/api/trace/{task}/{filter}/{episode}")
    def trace_header(asked: OfTwo) -> Response:
        traced = library.traced(asked)
        if not traced.ready(PATIENCE):
            return JSONResponse({"progress": traced.progress}, status_code=202)
        return JSONResponse(traced.header() | {"filter": asked.filter})

    @router.get("/api/trace/{task}/{filter}/{episode}/columns")
    def trace_columns(asked: OfTwo, request: Request) -> Response:
        traced = library.traced(asked)
        return _immutable(request, traced, "columns", lambda: traced.columns[1])

    @router.get("/api/trace/{task}/{filter}/{episode}/images")
    def trace_images(asked: OfTwo, request: Request) -> Response:
        traced = library.traced(asked)
        shown = pictures(traced.trace)
        if shown is None:
            raise HTTPException(404, f"Task {asked.task!r} has no pictures.")
        return _immutable(request, traced, "images", shown.tobytes)

    @router.get("/api/recordings")
    def list_recordings() -> list[dict[str, Any]]:
        paths = recordings.glob("*.rrd") if recordings.is_dir() else ()
        return [_listed(path) for path in sorted(paths, key=lambda p: -p.stat().st_mtime)]

    @router.post("/api/recordings", status_code=201)
    def record(wanted: RecordingRequest, response: Response) -> dict[str, Any]:
        started = time.perf_counter()
        traced = library.traced(_selection(wanted.task, wanted.filter, wanted.episode, wanted.recipe, wanted.data))
        trace = traced.trace
        # The name says all that the file depends on, so one that is there is this one.
        depends = f"{traced.key} maps {wanted.maps} diagnostics version {__version__}"
        parts = hashlib.sha256(depends.encode()).hexdigest()[:8]
        path = recordings / f"{wanted.task}-{wanted.filter}-episode{wanted.episode}-{parts}.rrd"
        steps = range(0, len(trace), wanted.maps) if wanted.maps and not no_maps(traced.checkpoint, trace) else ()
        with writing:
            there = path.is_file()
            if not there:
                recordings.mkdir(parents=True, exist_ok=True)
                maps = traced.maps(steps) if steps else None
                write_recording(trace, path, maps, diagnostics=quick(trace, traced.checkpoint))
        if there:
            response.status_code = 200
        return {
            "name": path.name,
            "url": f"/api/recordings/{quote(path.name)}",
            "bytes": path.stat().st_size,
            "seconds": None if there else time.perf_counter() - started,
        }

    @router.get("/api/recordings/{name}.rrd")
    def recording(name: str) -> Response:
        path = recordings / f"{name}.rrd"
        if not RECORDING.fullmatch(name) or "/" in name or not path.is_file():
            raise HTTPException(404, f"Recording {name + '.rrd'!r} does not exist.")
        return FileResponse(path, media_type="application/octet-stream", filename=path.name)

    @router.post("/api/views", status_code=201)
    async def open_view(wanted: Annotated[ViewRequest | None, Body()] = None) -> dict[str, str]:
        name = (await views.open(wanted is not None and wanted.dark)).name
        return {"view": name, "scene": f"/scene/{name}/", "socket": f"/api/views/{name}"}

    @router.websocket("/api/views/{name}")
    async def view_socket(websocket: WebSocket, name: str) -> None:
        try:
            view = views[name]
        except KeyError:
            await _no_view(websocket, name)
        else:
            await view.attend(websocket)

    @router.get("/scene/{name}/")
    async def scene_page(name: str, request: Request) -> Response:
        try:
            views[name]
        except KeyError:
            raise HTTPException(404, f"View {name!r} is not open.") from None
        return _tagged(request, scene_tag, lambda: scene, "text/html; charset=utf-8")

    @router.websocket("/scene/{name}")
    async def scene_socket(websocket: WebSocket, name: str) -> None:
        try:
            view = views[name]
        except KeyError:
            await _no_view(websocket, name)
        else:
            await view.scene.viser.connect(websocket)

    return router


def _immutable(request: Request, traced: Traced, part: str, content: Callable[[], bytes]) -> Response:
    """A part of a trace: its key says all that it depends on, so it can be an ETag."""
    traced.trace  # noqa: B018 - wait for it, or raise what it raised, before anything is answered
    return _tagged(request, f"{traced.key[:24]}-{part}", content, "application/octet-stream")


def _tagged(request: Request, tag: str, content: Callable[[], bytes], media_type: str) -> Response:
    headers = {"etag": f'"{tag}"', "cache-control": "no-cache"}
    if headers["etag"] in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=headers)
    return Response(content(), media_type=media_type, headers=headers)


def _listed(path: Path) -> dict[str, Any]:
    status = path.stat()
    modified = datetime.fromtimestamp(status.st_mtime, UTC).isoformat(timespec="seconds")
    entry: dict[str, Any] = {"name": path.name, "bytes": status.st_size, "modified": modified}
    # A task's name may hold a dash, as a filter's does: the known tasks say where it ends.
    task = max((t for t in TASKS if path.name.startswith(f"{t}-")), key=len, default=None)
    match = RECORDING.fullmatch(path.stem)
    if task is None or match is None:
        return entry | {"task": None, "filter": None, "episode": None}
    rest = path.stem[len(task) + 1 :].rsplit("-episode", 1)[0]
    return entry | {"task": task, "filter": rest, "episode": int(match["episode"])}


async def _no_view(websocket: WebSocket, name: str) -> None:
    # A browser shows its page neither status nor body of a refused handshake, but the code of a close.
    await websocket.accept()
    await websocket.close(4004, f"View {name!r} is not open.")
