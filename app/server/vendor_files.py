"""Browser code of other projects (Rerun's viewer and uPlot), served from their installed wheels.

Rerun's viewer is 67 MB of WebAssembly, and a third of it are function names for debuggers. It is served without them
and, once that is ready, brotli-compressed; both files are cached in the workspace.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
import threading
from collections.abc import Callable, Mapping
from pathlib import Path

import brotli
from starlette.requests import Request
from starlette.responses import FileResponse, Response

from beliefscope.datasets.io.atomic_write import write_atomically

UPLOT_FILES = ("uPlot.iife.js", "uPlot.min.css")
# widget.js is written for notebooks and does not export its viewer class.
EXPORT = b"\nexport { WebViewer };\n"
# The viewer omits cookies, which a server with a token requires.
FETCH = b"""const fetch = (input, ...options) =>
  globalThis.fetch(input instanceof Request ? new Request(input, { credentials: "same-origin" }) : input, ...options);
"""
CHUNK = 1 << 20  # bytes compressed between checks of the stop condition


class RerunViewer:
    """Rerun's web viewer as files under ``cache``.

    Args:
        cache: folder for the prepared files, created if missing. Several servers may share it.
    """

    def __init__(self, cache: Path) -> None:
        static = installed("rerun_notebook") / "static"
        version = importlib.metadata.version("rerun-notebook")
        cache.mkdir(parents=True, exist_ok=True)
        self._widget = static / "widget.js"
        self._original = static / "re_viewer_bg.wasm"
        self._wasm = cache / f"rerun-{version}.wasm"
        self._compressed = cache / f"rerun-{version}.wasm.br"
        self._lock = threading.Lock()

    def script(self) -> bytes:
        """The viewer's module, which exports ``WebViewer`` and loads ``re_viewer_bg.wasm`` from the same folder."""
        return FETCH + self._widget.read_bytes() + EXPORT

    def prepare(self, stopped: Callable[[], bool] = lambda: False) -> None:
        """Create the compressed file if it is missing, which takes about 5 s. Returns early when ``stopped``."""
        plain = self._stripped()
        if self._compressed.exists():
            return
        compressor, data, parts = brotli.Compressor(quality=5), plain.read_bytes(), []
        for start in range(0, len(data), CHUNK):
            if stopped():
                return
            parts.append(compressor.process(data[start : start + CHUNK]))
        write_atomically(self._compressed, b"".join([*parts, compressor.finish()]))

    def wasm(self, request: Request) -> Response:
        """The stripped module, compressed if the browser accepts that and the file is ready."""
        plain = self._stripped()
        headers = {"vary": "accept-encoding", "rerun-final-length": str(plain.stat().st_size)}
        if "br" in _accepted_encodings(request) and self._compressed.exists():
            return cached_file(request, self._compressed, "application/wasm", headers | {"content-encoding": "br"})
        return cached_file(request, plain, "application/wasm", headers)

    def _stripped(self) -> Path:
        with self._lock:
            if not self._wasm.exists():
                write_atomically(self._wasm, without_names(self._original.read_bytes()))
        return self._wasm


def installed(package: str) -> Path:
    """Folder of an installed package, located without importing it."""
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        raise RuntimeError(f"The package {package!r} is not installed; reinstall beliefscope.")
    return Path(spec.origin).parent


def without_names(module: bytes) -> bytes:
    """A WebAssembly module without its ``name`` section, which contains function names for debuggers.

    A module is an 8-byte preamble and sections: a byte of kind, the size as LEB128, the content. The content of kind 0,
    a custom section, begins with its name. Raises ValueError if ``module`` is not WebAssembly.
    """
    if module[:4] != b"\0asm":
        raise ValueError("Not a WebAssembly module.")
    sections, start = [module[:8]], 8
    while start < len(module):
        size, content = _leb128(module, start + 1)
        end = content + size
        length, name = _leb128(module, content) if module[start] == 0 else (0, content)
        if module[name : name + length] != b"name":
            sections.append(module[start:end])
        start = end
    return b"".join(sections)


def cached_file(request: Request, path: Path, media_type: str, headers: Mapping[str, str]) -> Response:
    """A file with an ETag (name, size and time of modification), or 304 if the browser's copy is current."""
    status = path.stat()
    key = f"{path.name} {status.st_size} {status.st_mtime_ns}"
    tag = f'"{hashlib.sha256(key.encode()).hexdigest()[:24]}"'
    common = {**headers, "etag": tag, "cache-control": "no-cache"}
    if tag in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=common)
    return FileResponse(path, media_type=media_type, headers=common)


def _leb128(data: bytes, start: int) -> tuple[int, int]:
    """An unsigned LEB128 number and the position after it."""
    value = shift = 0
    while True:
        byte = data[start]
        value |= (byte & 0x7F) << shift
        start, shift = start + 1, shift + 7
        if byte < 0x80:
            return value, start


def _accepted_encodings(request: Request) -> set[str]:
    return {part.partition(";")[0].strip() for part in request.headers.get("accept-encoding", "").split(",")}
