"""Trash of a folder: deleted files and folders that can be restored, each in its own folder under ``.deleted``."""

import os
import re
import secrets
import shutil
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from beliefscope.app.protocol.errors import NameTaken, NotFound

RETENTION_DAYS = 14

ID = re.compile(r"[0-9a-f]{1,16}-[0-9a-f]{8}")  # ms since 1970, and a random part


@dataclass(frozen=True)
class DeletedFile:
    """A file or folder in the trash. bytes: total size. deleted: time in s since 1970."""

    id: str
    name: str
    bytes: int
    deleted: float


class Trash:
    """The deleted files of one folder. Methods may be called from any thread."""

    def __init__(self, folder: Path) -> None:
        self._target = folder
        self._folder = folder / ".deleted"
        self._lock = threading.Lock()

    def put(self, path: Path) -> str:
        """Move a file or folder into the trash; return an id. Raises NotFound."""
        id = f"{time.time_ns() // 10**6:x}-{secrets.token_hex(4)}"
        entry = self._folder / id
        with self._lock:
            entry.mkdir(parents=True)
            try:
                os.rename(path, entry / path.name)
            except FileNotFoundError:
                entry.rmdir()
                raise NotFound(f"{path.name!r} no longer exists.") from None
        return id

    def restore(self, id: str) -> Path:
        """Move a file back to its folder. Raises NotFound or NameTaken."""
        with self._lock:
            path = self._path(id)
            if path is None:
                raise NotFound(f"Deleted file {id!r} no longer exists.")
            target = self._target / path.name
            if os.path.lexists(target):
                raise NameTaken(f"A file {path.name!r} already exists: rename it first.")
            os.rename(path, target)
            self._delete(id)
            return target

    def list_deleted(self) -> list[DeletedFile]:
        """The files in the trash, most recent first. Deletes expired ones."""
        files = []
        with self._lock:
            ids: list[str] = []
            with suppress(FileNotFoundError):
                ids = [entry.name for entry in self._folder.iterdir() if ID.fullmatch(entry.name)]
            for id in ids:
                deleted, path = int(id.partition("-")[0], 16) / 1e3, self._path(id)
                if path is None or deleted < time.time() - RETENTION_DAYS * 86400:
                    self._delete(id)
                else:
                    files.append(DeletedFile(id, path.name, disk_usage(path), deleted))
        return sorted(files, key=lambda file: -file.deleted)

    def empty(self) -> int:
        """Delete all files permanently; return their size in bytes."""
        files = self.list_deleted()
        with self._lock:
            for file in files:
                self._delete(file.id)
        return sum(file.bytes for file in files)

    def _path(self, id: str) -> Path | None:
        with suppress(OSError):
            if ID.fullmatch(id):
                return next((self._folder / id).iterdir(), None)
        return None

    def _delete(self, id: str) -> None:
        shutil.rmtree(self._folder / id, ignore_errors=True)


def disk_usage(path: Path) -> int:
    """Size in bytes of a file, or of all files in a folder. Files that disappear meanwhile count as empty."""
    total = 0
    for file in path.rglob("*") if path.is_dir() else [path]:
        with suppress(OSError):
            total += 0 if file.is_dir() else file.lstat().st_size
    return total
