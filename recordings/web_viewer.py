"""Rerun's web viewer, prepared for a browser.

It is 67 MB of WebAssembly, and a third of it are function names for debuggers. It is served without them and, once that
is ready, brotli-compressed; both files are cached.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import threading
from collections.abc import Callable
from pathlib import Path

import brotli

from beliefscope.datasets.io.atomic_write import write_atomically

# widget.js is written for notebooks and does not export its viewer class.
EXPORT = b"\nexport { WebViewer };\n"
# The viewer omits cookies, which a server with a token requires.
FETCH = b"""const fetch = (input, ...options) =>
  globalThis.fetch(input instanceof Request ? new Request(input, { credentials: "same-origin" }) : input, ...options);
"""
CHUNK = 1 << 20  # bytes compressed between checks of the stop condition


class WebViewer:
    """The viewer's files under ``cache``.

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
        plain = self.wasm()
        if self._compressed.exists():
            return
        compressor, data, parts = brotli.Compressor(quality=5), plain.read_bytes(), []
        for start in range(0, len(data), CHUNK):
            if stopped():
                return
            parts.append(compressor.process(data[start : start + CHUNK]))
        write_atomically(self._compressed, b"".join([*parts, compressor.finish()]))

    @property
    def compressed(self) -> Path | None:
        """The compressed module, if it is ready."""
        return self._compressed if self._compressed.exists() else None

    def wasm(self) -> Path:
        """The module without function names."""
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


def _leb128(data: bytes, start: int) -> tuple[int, int]:
    """An unsigned LEB128 number and the position after it."""
    value = shift = 0
    while True:
        byte = data[start]
        value |= (byte & 0x7F) << shift
        start, shift = start + 1, shift + 7
        if byte < 0x80:
            return value, start
