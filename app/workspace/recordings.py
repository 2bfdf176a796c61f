"""The `.rrd` files of a workspace: what is known of each, its tags, its name, and the trash.

What is known is kept beside them, in `.about/NAME.json`, for as long as size and time of the file are what they were.
Files that nobody knows yet are read one by one, in a process of its own each, while the others are listed.
"""

from __future__ import annotations

import json
import os
import shutil
import stat
import threading
import unicodedata
import uuid
from collections.abc import Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import NoReturn

from pydantic import TypeAdapter

from beliefscope.app.workspace.json_files import read_record
from beliefscope.app.workspace.recording_probe import About, Reader
from beliefscope.app.workspace.trash import Deleted, Gone, Taken, Trash
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import write_atomically

ENDING = ".rrd"
LONGEST = 200  # bytes of a name without its ending: a file under way has a longer one
MOST = 255  # bytes of a file's name
TAGS, TAG = 20, 40  # of a file, characters of one
WAITING = 64  # files read in the background at once, the others when these are done
AUTOMATIC, AUTOMATIC_BYTES = 50, 10**9  # of the files that were written to be looked at only


@dataclass(frozen=True)
class Kept:
    """A file's lines in `.about`. modified: ns. made_as: name that the page gave it. about: None where not known.

    automatic: it was written to be looked at, and nobody has said yet that it is to be kept.
    """

    bytes: int
    modified: int
    made_as: str = ""
    automatic: bool = False
    tags: tuple[str, ...] = ()
    about: About | None = None


KEPT = TypeAdapter(Kept)


@dataclass(frozen=True)
class Recording:
    """One file as it is now. bytes, modified (s since 1970): of the file. about: None while it is being read.

    automatic: it was written to be looked at, and goes when there are many of them.
    """

    name: str
    bytes: int
    modified: float
    automatic: bool
    tags: tuple[str, ...]
    about: About | None


class RrdFiles:
    """The recordings of one folder. Methods may be called from any thread, and block."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._about = folder / ".about"
        self._trash = Trash(folder)
        self._lock = threading.RLock()
        self._known: dict[str, tuple[int, Kept]] = {}  # name -> (ns at which its lines were written, they)
        self._read = Reader()
        self._reading = ThreadPoolExecutor(max_workers=1, thread_name_prefix="reading recordings")
        self._examining = ThreadPoolExecutor(max_workers=1, thread_name_prefix="examining recordings")
        self._asked: dict[str, tuple[int, int]] = {}  # name -> (bytes, ns) of what is waited for
        self._closing = False

    def all(self) -> list[Recording]:
        """The newest first. What is not known yet is read from now on."""
        with self._lock:
            found = []
            for name, status in self._files():
                kept = self._kept(name)
                known = kept if kept and (kept.bytes, kept.modified) == _stamp(status) else None
                if known is None or known.about is None:
                    self._ask(name, _stamp(status))
                tags = () if kept is None else kept.tags
                about = None if known is None else known.about
                automatic = known is not None and known.automatic
                found.append(Recording(name, status.st_size, status.st_mtime, automatic, tags, about))
            return sorted(found, key=lambda one: (-one.modified, one.name))

    def one(self, name: str) -> Recording:
        """Raises Gone where there is no such file."""
        path = self.path(name)
        return next((one for one in self.all() if one.name == path.name), None) or _gone(name)

    def deleted(self) -> list[Deleted]:
        """The last first."""
        with self._lock:
            return self._trash.all()

    def path(self, name: str) -> Path:
        """Of a file that is there; links are not followed. Raises Gone for any other name."""
        path = self.folder / (name.removesuffix(ENDING) + ENDING)
        if "/" in name or not _shown(path.name):
            _gone(name)
        try:
            regular = stat.S_ISREG(path.lstat().st_mode)
        except OSError:
            regular = False
        return path if regular else _gone(name)

    def free(self, name: str) -> Path:
        """Where a new file of that name would be. Raises BadInput for what is no name, Taken for a used one."""
        path = self.folder / (checked(name.removesuffix(ENDING)) + ENDING)
        if os.path.lexists(path):
            raise Taken(f"A recording {path.name!r} is there already. Give another name.")
        return path

    def made_as(self, name: str) -> Path | None:
        """The file that the page made under this name, whatever it is called now. None where there is none."""
        with self._lock:
            for found, status in self._files():
                kept = self._kept(found)
                if kept is None and found == name:
                    return self.folder / found  # ours, of a server that ended before it wrote this down
                if kept and kept.made_as == name and (kept.bytes, kept.modified) == _stamp(status):
                    return self.folder / found
        return None

    def unused(self, name: str) -> Path:
        """A path for a new file: of this name, or with a number behind it."""
        stem = name.removesuffix(ENDING)
        path = self.folder / f"{stem}{ENDING}"
        number = 2
        while os.path.lexists(path):
            path = self.folder / f"{stem}-{number}{ENDING}"
            number += 1
        return path

    def put(self, part: Path, about: About, made_as: str, automatic: bool) -> Path:
        """Gives a file that the page had written its name, or that with a number behind it.

        What it holds is kept first: who lists it meanwhile, also in another process, need not read it. Automatic: it
        was written to be looked at only; the oldest of those go where they are too many or too large.
        """
        with self._lock:
            path = self.unused(made_as)
            self._write(path.name, Kept(*_stamp(part.lstat()), made_as, automatic, about=about))
            os.rename(part, path)
            if automatic:
                self._thin()
            return path

    def keep(self, name: str) -> Recording:
        """A file that was written to be looked at is to be kept. Raises Gone."""
        with self._lock:
            path = self.path(name)
            kept = self._kept(path.name)
            if kept is not None and kept.automatic:
                self._write(path.name, replace(kept, automatic=False))
            return self.one(name)

    def part(self) -> Path:
        """Where a file may be written that is to be added; who asks removes it again."""
        self.folder.mkdir(parents=True, exist_ok=True)
        return self.folder / f".{uuid.uuid4().hex}.part"

    def examine(self, path: Path) -> Future[About]:
        """Has a file read in a process of its own, one at a time, however many ask.

        The future raises BadInput where Rerun cannot read the file whole.
        """

        def read() -> About:
            about = self._read(path)
            if not about.application:
                raise BadInput(about.problem)
            return about

        return self._examining.submit(read)

    def add(self, part: Path, name: str, about: About) -> Recording:
        """Gives a file that was examined its name. Raises as ``free``."""
        with self._lock:
            path = self.free(name)
            os.rename(part, path)
            self._write(path.name, Kept(*_stamp(path.lstat()), about=about))
            return self.one(path.name)

    def rename(self, name: str, new: str) -> Recording:
        """Raises Gone, BadInput for a name that cannot be one, and Taken."""
        with self._lock:
            path = self.path(name)
            if path.name == new.removesuffix(ENDING) + ENDING:
                return self.one(name)
            target = self.free(new)
            kept = self._kept(path.name)
            if kept is not None:  # first, so that no file is ever without its tags
                self._write(target.name, replace(kept, automatic=False))
            try:
                os.rename(path, target)
            except FileNotFoundError:
                self._forget(target.name)
                _gone(name)
            self._forget(path.name)
            return self.one(target.name)

    def tag(self, name: str, tags: Sequence[str]) -> Recording:
        """Gives a file these tags in place of those it had. Raises Gone, and BadInput for what cannot be a tag."""
        wanted = checked_tags(tags)
        with self._lock:
            path = self.path(name)
            kept = self._kept(path.name) or Kept(0, 0)
            self._write(path.name, replace(kept, tags=wanted, automatic=False))
            return self.one(name)

    def delete(self, name: str) -> str:
        """Into the trash; gives the id by which it is had back. Raises Gone."""
        with self._lock:
            path = self.path(name)
            id = self._trash.put(path, self._lines(path.name))
            self._known.pop(path.name, None)
            return id

    def restore(self, id: str) -> Recording:
        """Out of the trash, tags and all. Raises Gone, and Taken where its name is another's by now."""
        with self._lock:
            self._about.mkdir(parents=True, exist_ok=True)
            path = self._trash.restore(id, self.folder, self._about)
            self._known.pop(path.name, None)
            return self.keep(path.name)

    def empty(self) -> None:
        """Deletes for good what is in the trash."""
        with self._lock:
            self._trash.empty()

    def close(self) -> None:
        """Gives up what is being read."""
        self._closing = True
        self._read.close()
        for reading in (self._reading, self._examining):
            reading.shutdown(wait=True, cancel_futures=True)

    def _files(self) -> list[tuple[str, os.stat_result]]:
        """Names and states of all that are files themselves."""
        found = []
        with suppress(FileNotFoundError):
            for entry in os.scandir(self.folder):
                if _shown(entry.name):
                    with suppress(FileNotFoundError):  # it has just gone
                        if entry.is_file(follow_symlinks=False):
                            found.append((entry.name, entry.stat(follow_symlinks=False)))
        return found

    def _thin(self) -> None:
        """Lets go of the oldest that were written to be looked at only; the newest stays, however large."""
        there = [(status, name) for name, status in self._files() if (kept := self._kept(name)) and kept.automatic]
        there.sort(key=lambda one: -one[0].st_mtime_ns)
        sizes = accumulate(status.st_size for status, _ in there)
        for place, ((_, name), size) in enumerate(zip(there, sizes, strict=True)):
            if place and (place >= AUTOMATIC or size > AUTOMATIC_BYTES):
                (self.folder / name).unlink(missing_ok=True)
                self._forget(name)

    def _lines(self, name: str) -> Path:
        return self._about / f"{name}.json"

    def _kept(self, name: str) -> Kept | None:
        """Read again only when another server wrote it. Lines that cannot be read are none."""
        with suppress(OSError, ValueError):
            lines = self._lines(name)
            written = lines.stat().st_mtime_ns
            if name not in self._known or self._known[name][0] != written:
                kept = read_record(KEPT, lines)
                self._known[name] = written, replace(kept, tags=checked_tags(kept.tags))
            return self._known[name][1]
        return None

    def _write(self, name: str, kept: Kept) -> None:
        self._about.mkdir(parents=True, exist_ok=True)
        write_atomically(self._lines(name), json.dumps(asdict(kept)).encode())
        self._known.pop(name, None)

    def _forget(self, name: str) -> None:
        self._lines(name).unlink(missing_ok=True)
        self._known.pop(name, None)

    def _ask(self, name: str, stamp: tuple[int, int]) -> None:
        if self._closing or self._asked.get(name) == stamp or len(self._asked) >= WAITING:
            return
        self._asked[name] = stamp
        self._reading.submit(self._find_out, name, stamp)

    def _find_out(self, name: str, stamp: tuple[int, int]) -> None:
        try:
            with suppress(OSError, CancelledError):
                about = self._read(self.folder / name)
                with self._lock:
                    if _stamp((self.folder / name).lstat()) == stamp:
                        kept = self._kept(name) or Kept(*stamp)
                        self._write(name, Kept(*stamp, tags=kept.tags, about=about))
        finally:
            with self._lock:
                self._asked.pop(name, None)


def _shown(name: str) -> bool:
    """Whether a file of that name is listed: whoever put it there may have given it any bytes, and lines of its own."""
    return name.endswith(ENDING) and name[0] != "." and name.isprintable() and len(name.encode()) + len(".json") <= MOST


def checked(name: str) -> str:
    """A name for a file, without its ending. Raises BadInput for one that cannot be."""
    name = unicodedata.normalize("NFC", name)
    wrong = next((sign for sign in name if sign in '/\\<>:"|?*' or not sign.isprintable()), None)
    if not name:
        why = "is empty"
    elif wrong is not None:
        why = f"has {wrong!r} in it"
    elif name[0] in ". " or name[-1] in ". ":
        why = "begins or ends with a dot or a space"
    elif len(name.encode(errors="replace")) > LONGEST:
        why = f"is longer than {LONGEST} bytes"
    else:
        return name
    raise BadInput(f"Name {name[:LONGEST]!r} {why}. Letters, digits, spaces and -_+.,()= make a good one.")


def checked_tags(tags: Sequence[str]) -> tuple[str, ...]:
    """Each once, in the order given. Raises BadInput for one that cannot be."""
    found: dict[str, str] = {}
    for tag in (" ".join(tag.split()) for tag in tags):
        if not tag or len(tag) > TAG or "," in tag or not tag.isprintable():
            raise BadInput(f"Tag {tag[:TAG]!r} is not 1 to {TAG} characters without a comma.")
        found.setdefault(tag.casefold(), tag)
    if len(found) > TAGS:
        raise BadInput(f"{len(found)} tags are too many: {TAGS} at most.")
    return tuple(found.values())


def disk(folder: Path) -> int:
    """Bytes that are free where the folder is, or is going to be."""
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    return shutil.disk_usage(there).free


def _stamp(status: os.stat_result) -> tuple[int, int]:
    return status.st_size, status.st_mtime_ns


def _gone(name: str) -> NoReturn:
    raise Gone(f"Recording {name.removesuffix(ENDING) + ENDING!r} is not there, or no longer.")
