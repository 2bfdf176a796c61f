"""JSON files of the workspace as the values they stand for. Whoever may write there may have written anything."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter

from beliefscope.datasets.io.strict_json import read_json

T = TypeVar("T")

LARGEST = 64 << 20  # bytes of a record


def is_text(name: str) -> bool:
    """Whether the name of a file can be told in JSON; on Linux it may be any bytes, of another encoding for example."""
    return not any("\ud800" <= letter <= "\udfff" for letter in name)


def content(path: Path) -> bytes:
    """What a plain file holds. Raises OSError for anything else, too: a pipe or a device might never end."""
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode) or status.st_size > LARGEST:
            raise OSError(errno.EINVAL, "It is no plain file, or a large one", str(path))
        return file.read()


def read_record(kind: TypeAdapter[T], path: Path) -> T:
    """What a file holds, with fields of the right types. Raises OSError, and ValueError for anything else."""
    data = content(path)
    read_json(data)  # refuses what pydantic takes: NaN, wherever it stands
    return kind.validate_json(data, strict=True)
