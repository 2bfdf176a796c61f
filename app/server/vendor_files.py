"""Other projects' browser code, served from their installed wheels: Rerun's viewer and uPlot. Nothing is copied.

Rerun's viewer is 67 MB of WebAssembly, a third of it function names for debuggers. It is served without them, and
brotli-compressed once the first start has had the seconds that takes; both are kept in the workspace.
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
# widget.js is made for notebooks and keeps its viewer class to itself.
EXPORT = b"\nexport { WebViewer };\n"
# The viewer asks without cookies, and a server with a token answers nothing then.
FETCH = b"""const fetch = (asked, ...more) =>
  globalThis.fetch(asked instanceof Request ? new Request(asked, { credentials: "same-origin" }) : asked, ...more);
"""
COMPRESSED_AT_ONCE = 1 << 20  # bytes between two looks at whether the server is being stopped


class RerunViewer:
    """Rerun's web viewer as files under ``cache``.

    Args:
        cache: folder for the prepared files; made when needed. Two servers may share it.
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
        """The viewer's module, which exports ``WebViewer`` and loads ``re_viewer_bg.wasm`` from beside itself."""
        return FETCH + self._widget.read_bytes() + EXPORT

    def prepare(self, given_up: Callable[[], bool] = lambda: False) -> None:
        """Make the compressed file if it is missing: about 5 s of one core, once. Ends early when ``given_up``."""
        plain = self._stripped()
        if self._compressed.exists():
            return
        compressor, data, parts = brotli.Compressor(quality=5), plain.read_bytes(), []
        for start in range(0, len(data), COMPRESSED_AT_ONCE):
            if given_up():
                return
            parts.append(compressor.process(data[start : start + COMPRESSED_AT_ONCE]))
        write_atomically(self._compressed, b"".join([*parts, compressor.finish()]))

    def wasm(self, request: Request) -> Response:
        """The stripped module, compressed where the browser can and the file is ready. Blocks to strip it once."""
        plain = self._stripped()
        headers = {"vary": "accept-encoding", "rerun-final-length": str(plain.stat().st_size)}
        if "br" in _accepted(request) and self._compressed.exists():
            return cached_file(request, self._compressed, "application/wasm", headers | {"content-encoding": "br"})
        return cached_file(request, plain, "application/wasm", headers)

    def _stripped(self) -> Path:
        with self._lock:
            if not self._wasm.exists():
                write_atomically(self._wasm, without_names(self._original.read_bytes()))
        return self._wasm


def installed(package: str) -> Path:
    """Folder of an installed package, found without importing it."""
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        raise RuntimeError(f"The package {package!r} is not installed; reinstall beliefscope.")
    return Path(spec.origin).parent


def without_names(module: bytes) -> bytes:
    """A WebAssembly module without its ``name`` section (function names, for debuggers only).

    A module is an 8-byte preamble and sections: one byte of kind, the size as LEB128, the content. Kind 0 is a custom
    section, whose content begins with its name. Raises ValueError if ``module`` is not WebAssembly.
    """
    if module[:4] != b"\0asm":
        raise ValueError("Not a WebAssembly module.")
    kept, start = [module[:8]], 8
    while start < len(module):
        size, content = _leb128(module, start + 1)
        end = content + size
        length, name = _leb128(module, content) if module[start] == 0 else (0, content)
        if module[name : name + length] != b"name":
            kept.append(module[start:end])
        start = end
    return b"".join(kept)


def cached_file(request: Request, path: Path, media_type: str, headers: Mapping[str, str]) -> Response:
    """A file with an ETag (path, size and time of change), or 304 where the browser has it already."""
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


def _accepted(request: Request) -> set[str]:
    return {part.partition(";")[0].strip() for part in request.headers.get("accept-encoding", "").split(",")}
