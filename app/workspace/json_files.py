"""JSON files of the workspace, validated on reading: other programs may have written them."""

import errno
import os
import stat
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, Generic, TypeVar

from pydantic import TypeAdapter

from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.io.strict_json import read_json

T = TypeVar("T")

MAX_BYTES = 64 << 20  # of a record

_adapter: Callable[[Any], TypeAdapter[Any]] = cache(TypeAdapter)


def is_text(name: str) -> bool:
    """Whether a file name is valid Unicode. Linux allows arbitrary bytes, which cannot be written as JSON."""
    return not any("\ud800" <= letter <= "\udfff" for letter in name)


def content(path: Path) -> bytes:
    """Content of a regular file. Raises OSError for anything else: reading from a pipe or a device may not end."""
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode) or status.st_size > MAX_BYTES:
            raise OSError(errno.EINVAL, "Not a regular file, or too large", str(path))
        return file.read()


def read_record(kind: type[T], path: Path) -> T:
    """Read a JSON file, validated as ``kind``. Raises OSError, or ValueError for invalid content."""
    data = content(path)
    read_json(data)  # rejects NaN and infinities, which pydantic accepts
    record: T = _adapter(kind).validate_json(data, strict=True)
    return record


def write_record(record: Any, path: Path) -> None:
    """Write a dataclass or model, or a list of them, as JSON; creates the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, _adapter(type(record)).dump_json(record))


class RecordCache(Generic[T]):
    """Records of files; a file is read again only if it has changed. Not thread-safe."""

    def __init__(self, read: Callable[[Path], T]) -> None:
        """read: path -> record; raises OSError or ValueError for an invalid file."""
        self._read = read
        self._records: dict[Path, tuple[int, T]] = {}  # with the time of the file in ns

    def get(self, path: Path) -> T | None:
        """The record of a file; None if the file is missing or invalid."""
        with suppress(OSError, ValueError):
            modified = path.stat().st_mtime_ns
            if path not in self._records or self._records[path][0] != modified:
                self._records[path] = modified, self._read(path)
            return self._records[path][1]
        return None

    def modified(self, path: Path) -> int | None:
        """Time of the file in ns if its record is valid, else None."""
        return None if self.get(path) is None else self._records[path][0]

    def put(self, path: Path, record: T) -> None:
        """Write a record."""
        write_record(record, path)
        self._records.pop(path, None)
