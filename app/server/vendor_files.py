"""Responses with browser code of other projects (Rerun's viewer and uPlot), from their installed wheels."""

from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.staticfiles import NotModifiedResponse, StaticFiles

from beliefscope.recordings.web_viewer import WebViewer

UPLOT_FILES = ("uPlot.iife.js", "uPlot.min.css")


def viewer_wasm(viewer: WebViewer, request: Request) -> Response:
    """The viewer's WebAssembly, compressed if the browser accepts that and the file is ready; or 304."""
    path = plain = viewer.wasm()
    headers = {"vary": "accept-encoding", "rerun-final-length": str(plain.stat().st_size), "cache-control": "no-cache"}
    accepted = {part.partition(";")[0].strip() for part in request.headers.get("accept-encoding", "").split(",")}
    if "br" in accepted and viewer.compressed is not None:
        path, headers["content-encoding"] = viewer.compressed, "br"
    response = FileResponse(path, media_type="application/wasm", headers=headers, stat_result=path.stat())
    if StaticFiles().is_not_modified(response.headers, request.headers):
        return NotModifiedResponse(response.headers)
    return response
