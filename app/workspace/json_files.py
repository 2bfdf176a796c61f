"""JSON files of the workspace, validated on reading: other programs may have written them."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter

from beliefscope.datasets.io.strict_json import read_json

T = TypeVar("T")

MAX_BYTES = 64 << 20  # of a record


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


def read_record(adapter: TypeAdapter[T], path: Path) -> T:
    """Read and validate a JSON file. Raises OSError, or ValueError for invalid content."""
    data = content(path)
    read_json(data)  # rejects NaN and infinities, which pydantic accepts
    return adapter.validate_json(data, strict=True)
