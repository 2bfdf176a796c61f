"""The page's interface (docs/api.md): catalog, traces, views."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Annotated, Any

from fastapi import APIRouter, Body, Depends, HTTPException, Request, WebSocket
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel, ConfigDict

from beliefscope import __version__
from beliefscope.app.protocol.etag import tagged
from beliefscope.app.protocol.messages import closing, pictures
from beliefscope.app.runs.trace_store import Library, Selection, Traced
from beliefscope.app.views.embedded_viser import client_page
from beliefscope.app.views.view import Views
from beliefscope.datasets.faults.injection import Faults, described

PATIENCE = 0.25  # s that a request for a trace waits before it says how far the trace is


class ViewRequest(BaseModel):
    """Body of ``POST /api/views``."""

    model_config = ConfigDict(extra="forbid", strict=True)
    dark: bool = False


def _selection(task: str, filter: str, episode: int, faults: str = "", data: str = "") -> Selection:
    return Selection(task, filter, episode, Faults.parse(faults), data)


Asked = Annotated[Selection, Depends(_selection)]
"""What a path and its query name."""


def _of_two(asked: Asked, against: str = "") -> Selection:
    return asked.against(against) if against else asked


OfTwo = Annotated[Selection, Depends(_of_two)]
"""The same, or the other run that it is compared with, where ``against`` says what differs."""


def routes(library: Library, views: Views) -> APIRouter:
    """Every route under ``/api``, ``/scene`` and ``/healthz``. What blocks runs in worker threads (plain ``def``)."""
    router = APIRouter()
    scene = client_page("/static/scene/viser_frame_throttle.js")
    scene_tag = hashlib.sha256(scene).hexdigest()[:24]

    @router.get("/healthz")
    async def health() -> dict[str, str | float]:
        return {"status": "ok", "version": __version__, "late": round(views.late(), 1)}

    @router.get("/api/catalog")
    def catalog(request: Request) -> dict[str, Any]:
        about = {"version": __version__, "read_only": request.app.state.read_only, "faults": described()}
        return {**about, **library.catalog()}

    @router.get("/api/trace/{task}/{filter}/{episode}")
    def trace_header(asked: OfTwo) -> Response:
        traced = library.traced(asked)
        return _once_there(traced, lambda: JSONResponse(traced.header() | {"filter": asked.filter}))

    @router.get("/api/trace/{task}/{filter}/{episode}/columns")
    def trace_columns(asked: OfTwo, request: Request) -> Response:
        traced = library.traced(asked)
        return _once_there(traced, lambda: _immutable(request, traced, "columns", lambda: traced.columns[1]))

    @router.get("/api/trace/{task}/{filter}/{episode}/images")
    def trace_images(asked: OfTwo, request: Request) -> Response:
        traced = library.traced(asked)

        def images() -> Response:
            shown = pictures(traced.trace)
            if shown is None:
                raise HTTPException(404, f"Task {asked.task!r} has no pictures.")
            return _immutable(request, traced, "images", shown.tobytes)

        return _once_there(traced, images)

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
        return tagged(request, scene_tag, lambda: scene, "text/html; charset=utf-8")

    @router.websocket("/scene/{name}")
    async def scene_socket(websocket: WebSocket, name: str) -> None:
        try:
            view = views[name]
        except KeyError:
            await _no_view(websocket, name)
        else:
            await view.scene.viser.connect(websocket)

    return router


def _once_there(traced: Traced, answer: Callable[[], Response]) -> Response:
    """How far the trace is, until it is there. Nobody waits for it here: those who did would keep out all others."""
    if not traced.ready(PATIENCE):
        return JSONResponse({"progress": traced.progress}, status_code=202)
    return answer()


def _immutable(request: Request, traced: Traced, part: str, content: Callable[[], bytes]) -> Response:
    """A part of a trace: its key says all that it depends on, so it can be an ETag."""
    return tagged(request, f"{traced.key[:24]}-{part}", content, "application/octet-stream")


async def _no_view(websocket: WebSocket, name: str) -> None:
    # A browser shows its page neither status nor body of a refused handshake, but the code of a close.
    await websocket.accept()
    await websocket.close(4004, closing(f"View {name!r} is not open."))
