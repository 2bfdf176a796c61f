"""The page's own files, at addresses with a hash of their content, which browsers may cache forever.

The page has about fifty modules and no build step. So that browsers need not discover them one level of imports at a
time, the index lists all of them for preloading.
"""

from __future__ import annotations

import hashlib
import mimetypes
import posixpath
import re
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from fastapi import HTTPException
from starlette.requests import Request
from starlette.responses import Response

from beliefscope.app.protocol.etag import IMMUTABLE, REVALIDATE, tagged

ENTRY = "core/main.js"
_IMPORT = re.compile(rb"""^(?:import|export)\b[\w\s{},*$]*['"](\.\.?/[\w./-]+)['"]""", re.MULTILINE)
_NAMED = re.compile(r"/static/([\w./-]+)")


class PageFiles:
    """The current files; edited ones are used at the next reload."""

    def __init__(self, folder: Path, others: Iterable[Path] = ()) -> None:
        """folder: ``index.html`` and, in subfolders, scripts and styles. others: files of other packages."""
        self._folder = folder
        self._others = tuple(others)
        self._served: dict[str, dict[str, tuple[bytes, str]]] = {}

    def index(self, request: Request) -> Response:
        """The page."""
        files = self._files()
        version = _version(files)
        if version not in self._served:
            self._served = {version: {name: _content(*file) for name, file in files.items()}}
        content = _index(self._folder, version)
        return tagged(request, _hash(content), lambda: content, "text/html; charset=utf-8")

    def file(self, request: Request, path: str) -> Response:
        """``HASH/NAME`` as in the index, immutable; or ``NAME``, revalidated. Raises HTTPException 404.

        Files of the newest index are sent from memory: while the first trace is computed, each look at the disk waits
        for the interpreter lock, and the page has a hundred files.
        """
        version, _, name = path.partition("/")
        served = self._served.get(version, {})
        if name in served:
            return _response(request, name, *served[name], IMMUTABLE)
        files = self._files()
        version, name = ("", path) if path in files else (version, name)
        if name not in files:
            raise HTTPException(404, f"{path!r} is not a file of the page.")
        return _response(
            request, name, *_content(*files[name]), IMMUTABLE if version == _version(files) else REVALIDATE
        )

    def _files(self) -> dict[str, tuple[Path, int, int]]:
        """Name -> path, size and time of modification; takes about 0.2 ms."""
        paths = {path.relative_to(self._folder).as_posix(): path for path in sorted(self._folder.rglob("*.*"))}
        paths |= {path.name: path for path in self._others}
        stats = {name: (path, path.stat()) for name, path in paths.items()}
        return {name: (path, status.st_size, status.st_mtime_ns) for name, (path, status) in stats.items()}


def _response(request: Request, name: str, content: bytes, tag: str, cache_control: str) -> Response:
    kind = mimetypes.guess_type(name)[0] or "application/octet-stream"
    media_type = f"{kind}; charset=utf-8" if kind.startswith("text/") else kind
    return tagged(request, tag, lambda: content, media_type, cache_control)


def modules(folder: Path) -> list[str]:
    """The page's entry module and all modules it imports, in breadth-first order."""
    names = [ENTRY]
    for name in names:
        imported = (_resolved(name, match.decode()) for match in _IMPORT.findall((folder / name).read_bytes()))
        names += [other for other in dict.fromkeys(imported) if other not in names]
    return names


def _resolved(importer: str, specifier: str) -> str:
    """Path of an imported module relative to the page's folder."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(importer), specifier))


def page_files(folder: Path) -> list[str]:
    """All files that the page uses. Raises OSError if the index or a module is missing."""
    index = (folder / "index.html").read_text(encoding="utf-8")
    return [*dict.fromkeys([*_NAMED.findall(index), *modules(folder)])]


def _version(files: dict[str, tuple[Path, int, int]]) -> str:
    return _hash(repr(files).encode())[:12]


@lru_cache(maxsize=2)
def _index(folder: Path, version: str) -> bytes:
    where = f"/static/{version}/"
    # Preload everything that the first frame needs.
    preloads = ['<link rel="preload" href="/api/catalog" as="fetch" crossorigin="anonymous">']
    preloads += [f'<link rel="modulepreload" href="{where}{name}">' for name in modules(folder)]
    text = (folder / "index.html").read_text(encoding="utf-8").replace("/static/", where)
    return text.replace("</head>", "\n".join([*preloads, "</head>"]), 1).encode()


@lru_cache(maxsize=256)
def _content(path: Path, size: int, modified: int) -> tuple[bytes, str]:
    """Content and hash of a file; the arguments after ``path`` identify its version."""
    content = path.read_bytes()
    return content, _hash(content)


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:24]
