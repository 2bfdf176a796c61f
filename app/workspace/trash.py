"""What was deleted and can be had back: files and folders of a workspace, each in a folder under `.deleted`."""

from __future__ import annotations

import os
import re
import secrets
import shutil
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from beliefscope.datasets.errors import BadInput

DAYS = 14
"""For which it is kept."""

ID = re.compile(r"(?P<milliseconds>[0-9a-f]{1,16})-[0-9a-f]{8}")
ABOUT = ".about"
"""Name in the folder of what belongs to the deleted file and has no name of its own."""


class Gone(BadInput):
    """What is named is not there, or no longer."""


class Taken(BadInput):
    """The name is another's."""


@dataclass(frozen=True)
class Deleted:
    """One that was. bytes: of all its files. deleted: s since 1970."""

    id: str
    name: str
    bytes: int
    deleted: float


class Trash:
    """The deleted files of one folder. Whoever calls sees to it that nobody else does meanwhile."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder / ".deleted"

    def put(self, path: Path, about: Path | None = None) -> str:
        """Takes a file or folder out of its own, and what belongs to it; gives what it is asked back by.

        Raises Gone where it is not there.
        """
        id = f"{time.time_ns() // 10**6:x}-{secrets.token_hex(4)}"
        place = self._folder / id
        place.mkdir(parents=True)
        try:
            os.rename(path, place / path.name)
        except FileNotFoundError:
            place.rmdir()
            raise Gone(f"{path.name!r} is no longer there.") from None
        if about is not None:
            with suppress(FileNotFoundError):
                os.rename(about, place / ABOUT)
        return id

    def restore(self, id: str, folder: Path, about: Path | None = None) -> Path:
        """Puts it back into the folder, and what belongs to it into the other. Raises Gone, and Taken for its name."""
        found = self._named(id)
        if found is None:
            raise Gone(f"Deleted file {id!r} is no longer there to be had back.")
        target = folder / found.name
        if os.path.lexists(target):
            raise Taken(f"Another {found.name!r} is there by now: rename that one first.")
        if about is not None:
            with suppress(FileNotFoundError):
                os.replace(found.parent / ABOUT, about / f"{found.name}.json")
        os.rename(found, target)
        shutil.rmtree(found.parent, ignore_errors=True)
        return target

    def all(self) -> list[Deleted]:
        """The last deleted first; those whose time is over are gone."""
        kept = []
        for id in self._ids():
            when, found = int(id.partition("-")[0], 16) / 1e3, self._named(id)
            if found is None or when < time.time() - DAYS * 86400:
                self._drop(id)
            else:
                kept.append(Deleted(id, found.name, size(found), when))
        return sorted(kept, key=lambda one: -one.deleted)

    def empty(self) -> None:
        """Deletes all for good."""
        for id in self._ids():
            self._drop(id)

    def _ids(self) -> list[str]:
        with suppress(FileNotFoundError):
            return [entry.name for entry in os.scandir(self._folder) if ID.fullmatch(entry.name)]
        return []

    def _named(self, id: str) -> Path | None:
        with suppress(OSError):
            if ID.fullmatch(id):
                return next((path for path in (self._folder / id).iterdir() if path.name != ABOUT), None)
        return None

    def _drop(self, id: str) -> None:
        shutil.rmtree(self._folder / id, ignore_errors=True)


def size(path: Path) -> int:
    """Bytes of a file, or of all files in a folder; what vanishes meanwhile has none."""
    paths = path.rglob("*") if path.is_dir() else [path]
    total = 0
    for one in paths:
        with suppress(OSError):
            status = one.lstat()
            total += 0 if one.is_dir() else status.st_size
    return total
