"""The page's own files. Each has an address that says what is in it, so that a browser asks for it once only.

The page is some fifty modules without a build step. A browser would find them out a level of imports at a time, and
ask for each again at every reload. Here the index names all of them, and its addresses of them hold a hash.
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

from beliefscope.app.protocol.etag import ASK_AGAIN, FOREVER, tagged

ENTRY = "core/main.js"
_IMPORT = re.compile(rb"""^(?:import|export)\b[^'"]*['"](\.\.?/[\w./-]+)['"]""", re.MULTILINE)
_NAMED = re.compile(r"/static/([\w./-]+)")


class PageFiles:
    """The files as they are now: where one is edited, the next reload has it."""

    def __init__(self, folder: Path, others: Iterable[Path] = ()) -> None:
        """Folder: ``index.html`` and, in its subfolders, scripts and styles. Others: files elsewhere that it uses."""
        self._folder = folder
        self._others = tuple(others)

    def index(self, request: Request) -> Response:
        """The page."""
        files = self._files()
        content = _index(self._folder, _version(files))
        return tagged(request, _hash(content), lambda: content, "text/html; charset=utf-8")

    def file(self, request: Request, path: str) -> Response:
        """``HASH/NAME`` as in the index, cached for good; or only ``NAME``, revalidated. Raises HTTPException 404."""
        files = self._files()
        version, _, name = ("", "", path) if path in files else path.partition("/")
        if name not in files:
            raise HTTPException(404, f"{path!r} is not a file of the page.")
        content, tag = _content(*files[name])
        kind = mimetypes.guess_type(name)[0] or "application/octet-stream"
        media_type = f"{kind}; charset=utf-8" if kind.startswith("text/") else kind
        kept = FOREVER if version == _version(files) else ASK_AGAIN
        return tagged(request, tag, lambda: content, media_type, kept)

    def _files(self) -> dict[str, tuple[Path, int, int]]:
        """Name -> path, bytes, and when it changed; some 0.2 ms."""
        own = {path.relative_to(self._folder).as_posix(): path for path in sorted(self._folder.rglob("*.*"))}
        stats = {name: (path, path.stat()) for name, path in (own | {path.name: path for path in self._others}).items()}
        return {name: (path, status.st_size, status.st_mtime_ns) for name, (path, status) in stats.items()}


def modules(folder: Path) -> list[str]:
    """The page's first module and all that it imports, each once, the nearest first."""
    found = [ENTRY]
    for name in found:
        imported = (_resolved(name, match.decode()) for match in _IMPORT.findall((folder / name).read_bytes()))
        found += [other for other in dict.fromkeys(imported) if other not in found]
    return found


def _resolved(importer: str, specifier: str) -> str:
    """Path of an imported module in the folder of the page."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(importer), specifier))


def named(folder: Path) -> list[str]:
    """Every file that the page is drawn with. Raises OSError where the index or a module is missing."""
    index = (folder / "index.html").read_text(encoding="utf-8")
    return [*dict.fromkeys([*_NAMED.findall(index), *modules(folder)])]


def _version(files: dict[str, tuple[Path, int, int]]) -> str:
    return _hash(repr(files).encode())[:12]


@lru_cache(maxsize=2)
def _index(folder: Path, version: str) -> bytes:
    where = f"/static/{version}/"
    # What the first picture needs is asked for at once: no script need be read to know of the next.
    early = ['<link rel="preload" href="/api/catalog" as="fetch" crossorigin="anonymous">']
    early += [f'<link rel="modulepreload" href="{where}{name}">' for name in modules(folder)]
    text = (folder / "index.html").read_text(encoding="utf-8").replace("/static/", where)
    return text.replace("</head>", "\n".join([*early, "</head>"]), 1).encode()


@lru_cache(maxsize=256)
def _content(path: Path, size: int, changed: int) -> tuple[bytes, str]:
    """A file as it is since then, and its hash."""
    content = path.read_bytes()
    return content, _hash(content)


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:24]
