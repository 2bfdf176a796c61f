"""Routes of views: the page's socket and its 3D scene."""

import hashlib
from typing import Annotated

from fastapi import Body, FastAPI, Request, WebSocket
from fastapi.responses import Response

from beliefscope.app.api.models import Reply, RequestBody
from beliefscope.app.protocol.errors import NotFound
from beliefscope.app.protocol.etag import tagged
from beliefscope.app.protocol.messages import close_reason
from beliefscope.app.views.embedded_viser import client_page
from beliefscope.app.views.registry import Views
from beliefscope.app.views.view_socket import View


class ViewAddresses(Reply):
    """Addresses of an open view."""

    view: str
    scene: str
    socket: str


class ViewRequest(RequestBody):
    """Body of ``POST /api/views``."""

    dark: bool = False


def add_routes(app: FastAPI, views: Views) -> None:
    scene = client_page()
    scene_tag = hashlib.sha256(scene).hexdigest()[:24]

    @app.post("/api/views", status_code=201)
    async def open_view(options: Annotated[ViewRequest | None, Body()] = None) -> ViewAddresses:
        name = (await views.open(options is not None and options.dark)).name
        return ViewAddresses(view=name, scene=f"/scene/{name}/", socket=f"/api/views/{name}")

    @app.websocket("/api/views/{name}")
    async def view_socket(websocket: WebSocket, name: str) -> None:
        if view := await _find_view(views, websocket, name):
            await view.serve(websocket)

    @app.get("/scene/{name}/")
    async def scene_page(name: str, request: Request) -> Response:
        views[name]  # raises NotFound
        return tagged(request, scene_tag, lambda: scene, "text/html; charset=utf-8")

    @app.websocket("/scene/{name}")
    async def scene_socket(websocket: WebSocket, name: str) -> None:
        if view := await _find_view(views, websocket, name):
            await view.scene.viser.connect(websocket)


async def _find_view(views: Views, websocket: WebSocket, name: str) -> View | None:
    try:
        return views[name]
    except NotFound as error:
        # Browsers do not expose the response to a refused handshake, but they do expose a close code.
        await websocket.accept()
        await websocket.close(4004, close_reason(str(error)))
        return None
