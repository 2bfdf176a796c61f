"""Trash of a folder: deleted files and folders that can be restored, each in its own folder under ``.deleted``."""

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

RETENTION_DAYS = 14

ID = re.compile(r"(?P<milliseconds>[0-9a-f]{1,16})-[0-9a-f]{8}")
METADATA = ".about"
"""Name under which the metadata of a deleted file is stored."""


class NotFound(BadInput):
    """The file does not exist, or no longer."""


class NameTaken(BadInput):
    """Another file has the name."""


@dataclass(frozen=True)
class DeletedFile:
    """A file or folder in the trash. bytes: total size. deleted: time in s since 1970."""

    id: str
    name: str
    bytes: int
    deleted: float


class Trash:
    """The deleted files of one folder. Not thread-safe."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder / ".deleted"

    def put(self, path: Path, metadata: Path | None = None) -> str:
        """Move a file or folder and its metadata into the trash; return an id. Raises NotFound."""
        id = f"{time.time_ns() // 10**6:x}-{secrets.token_hex(4)}"
        entry = self._folder / id
        entry.mkdir(parents=True)
        try:
            os.rename(path, entry / path.name)
        except FileNotFoundError:
            entry.rmdir()
            raise NotFound(f"{path.name!r} does not exist any more.") from None
        if metadata is not None:
            with suppress(FileNotFoundError):
                os.rename(metadata, entry / METADATA)
        return id

    def restore(self, id: str, folder: Path, metadata_folder: Path | None = None) -> Path:
        """Move a file back into ``folder``, and its metadata into the other one. Raises NotFound or NameTaken."""
        path = self._path(id)
        if path is None:
            raise NotFound(f"Deleted file {id!r} does not exist any more.")
        target = folder / path.name
        if os.path.lexists(target):
            raise NameTaken(f"A file {path.name!r} already exists: rename it first.")
        if metadata_folder is not None:
            with suppress(FileNotFoundError):
                os.replace(path.parent / METADATA, metadata_folder / f"{path.name}.json")
        os.rename(path, target)
        shutil.rmtree(path.parent, ignore_errors=True)
        return target

    def list_deleted(self) -> list[DeletedFile]:
        """The files in the trash, most recent first. Deletes expired ones."""
        files = []
        for id in self._ids():
            deleted, path = int(id.partition("-")[0], 16) / 1e3, self._path(id)
            if path is None or deleted < time.time() - RETENTION_DAYS * 86400:
                self._delete(id)
            else:
                files.append(DeletedFile(id, path.name, disk_usage(path), deleted))
        return sorted(files, key=lambda file: -file.deleted)

    def empty(self) -> None:
        """Delete all files permanently."""
        for id in self._ids():
            self._delete(id)

    def _ids(self) -> list[str]:
        with suppress(FileNotFoundError):
            return [entry.name for entry in os.scandir(self._folder) if ID.fullmatch(entry.name)]
        return []

    def _path(self, id: str) -> Path | None:
        with suppress(OSError):
            if ID.fullmatch(id):
                return next((path for path in (self._folder / id).iterdir() if path.name != METADATA), None)
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
