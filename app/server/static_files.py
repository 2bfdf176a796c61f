"""The page's own files, at addresses with a hash of their content, which browsers may cache forever.

The page has more than a hundred files and no build step, and a request costs a browser a few milliseconds. So the
styles are sent as one file, modules that are imported by a call load when the page needs them, and the index lists all
others for preloading: browsers need not discover them one level of imports at a time.
"""

import hashlib
import mimetypes
import posixpath
import re
from collections.abc import Iterable
from pathlib import Path

from fastapi import HTTPException
from starlette.requests import Request
from starlette.responses import Response

from beliefscope.app.protocol.etag import IMMUTABLE, REVALIDATE, tagged

ENTRY = "core/main.js"
_IMPORT = re.compile(rb"""^(?:import|export)\b[\w\s{},*$]*['"](\.\.?/[\w./-]+)['"]""", re.MULTILINE)
_IMPORT_CALL = re.compile(rb"""\bawait import\(['"](\.\.?/[\w./-]+)['"]\)""")
_NAMED = re.compile(r"/static/([\w./-]+)")
_STYLE = re.compile(r'<link rel="stylesheet" href="/static/(styles/[\w.-]+)">\n')
_STYLES = re.compile(f"(?:{_STYLE.pattern})+")
STYLES = "styles/all.css"  # the styles of the page, in their order


class PageFiles:
    """The current files, in memory: while the first trace is computed, each look at the disk waits for the interpreter
    lock, and the page has a hundred files. Edited ones are used at the next reload.
    """

    def __init__(self, folder: Path, others: Iterable[Path] = ()) -> None:
        """folder: ``index.html`` and, in subfolders, scripts and styles. others: files of other packages."""
        self._folder, self._others = folder, tuple(others)
        self._version = ""
        self._index = b""
        self._files: dict[str, tuple[bytes, str]] = {}  # content and hash

    # Handlers in the event loop, from memory: a browser requests all files at once.
    async def index(self, request: Request) -> Response:
        """The page."""
        self._read()
        return tagged(request, _hash(self._index), lambda: self._index, "text/html; charset=utf-8")

    async def file(self, request: Request, path: str) -> Response:
        """``HASH/NAME`` as in the index, immutable; or ``NAME``, revalidated. Raises HTTPException 404."""
        version, _, name = path.partition("/")
        if version != self._version or name not in self._files:
            self._read()
            version, name = ("", path) if path in self._files else (version, name)
        if name not in self._files:
            raise HTTPException(404, f"{path!r} is not a file of the page.")
        content, tag = self._files[name]
        kind = mimetypes.guess_type(name)[0] or "application/octet-stream"
        media_type = f"{kind}; charset=utf-8" if kind.startswith("text/") else kind
        cache_control = IMMUTABLE if version == self._version else REVALIDATE
        return tagged(request, tag, lambda: content, media_type, cache_control)

    def _read(self) -> None:
        """Read all files, unless they are unchanged, which takes about 0.2 ms to see."""
        paths = {path.relative_to(self._folder).as_posix(): path for path in sorted(self._folder.rglob("*.*"))}
        paths |= {path.name: path for path in self._others}
        states = [(name, path, path.stat()) for name, path in paths.items()]
        version = _hash(repr([(name, state.st_size, state.st_mtime_ns) for name, _, state in states]).encode())[:12]
        if version != self._version:
            contents = {name: path.read_bytes() for name, path, _ in states}
            contents[STYLES] = b"".join(contents[name] for name in _STYLE.findall(contents["index.html"].decode()))
            self._index = page_index(self._folder, version)
            self._files = {name: (content, _hash(content)) for name, content in contents.items()}
            self._version = version


def modules(folder: Path, lazy: bool = False) -> list[str]:
    """The page's entry module and the modules it imports, in breadth-first order.

    lazy: also modules that are imported by a call, when the page needs them.
    """
    names = [ENTRY]
    for name in names:
        content = (folder / name).read_bytes()
        paths = [*_IMPORT.findall(content), *(_IMPORT_CALL.findall(content) if lazy else ())]
        imported = (posixpath.normpath(posixpath.join(posixpath.dirname(name), path.decode())) for path in paths)
        names += [other for other in dict.fromkeys(imported) if other not in names]
    return names


def page_files(folder: Path) -> list[str]:
    """All files that the page uses. Raises OSError if the index or a module is missing."""
    index = (folder / "index.html").read_text(encoding="utf-8")
    return [*dict.fromkeys([*_NAMED.findall(index), *modules(folder, lazy=True)])]


def page_index(folder: Path, version: str) -> bytes:
    """The page with the addresses of a version of its files; it preloads everything that the first frame needs."""
    where = f"/static/{version}/"
    preloads = ['<link rel="preload" href="/api/catalog" as="fetch" crossorigin="anonymous">']
    preloads += [f'<link rel="modulepreload" href="{where}{name}">' for name in modules(folder)]
    text = (folder / "index.html").read_text(encoding="utf-8")
    text = _STYLES.sub(f'<link rel="stylesheet" href="/static/{STYLES}">\n', text).replace("/static/", where)
    return text.replace("</head>", "\n".join([*preloads, "</head>"]), 1).encode()


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:24]
