"""Responses with browser code of other projects (Rerun's viewer and uPlot), from their installed wheels."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

from starlette.requests import Request
from starlette.responses import FileResponse, Response

from beliefscope.recordings.web_viewer import WebViewer

UPLOT_FILES = ("uPlot.iife.js", "uPlot.min.css")


def viewer_wasm(viewer: WebViewer, request: Request) -> Response:
    """The viewer's WebAssembly, compressed if the browser accepts that and the file is ready."""
    plain, compressed = viewer.wasm(), viewer.compressed
    headers = {"vary": "accept-encoding", "rerun-final-length": str(plain.stat().st_size)}
    accepted = {part.partition(";")[0].strip() for part in request.headers.get("accept-encoding", "").split(",")}
    if compressed is not None and "br" in accepted:
        return cached_file(request, compressed, "application/wasm", headers | {"content-encoding": "br"})
    return cached_file(request, plain, "application/wasm", headers)


def cached_file(request: Request, path: Path, media_type: str, headers: Mapping[str, str]) -> Response:
    """A file with an ETag (name, size and time of modification), or 304 if the browser's copy is current."""
    status = path.stat()
    key = f"{path.name} {status.st_size} {status.st_mtime_ns}"
    tag = f'"{hashlib.sha256(key.encode()).hexdigest()[:24]}"'
    common = {**headers, "etag": tag, "cache-control": "no-cache"}
    if tag in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=common)
    return FileResponse(path, media_type=media_type, headers=common)
