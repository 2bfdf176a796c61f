"""Atomic file writes."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from errno import EDQUOT, ENOSPC
from pathlib import Path
from typing import BinaryIO

from beliefscope.datasets.errors import BadInput


def write_atomically(path: Path, data: bytes) -> None:
    """Replace a file atomically. Raises BadInput if it cannot be written, e.g. for a missing folder or a full disk."""
    with replacing(path) as file:
        file.write(data)


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Yields a temporary file that replaces ``path`` when the block ends, unless with an error.

    Raises BadInput as ``write_atomically``.
    """
    path = Path(path)
    try:
        if not path.parent.is_dir():
            raise BadInput(f"folder {str(path.parent)!r} does not exist")
        handle, temporary = tempfile.mkstemp(".part", f".{path.name[:100]}.", path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.chmod(temporary, 0o644)
            os.replace(temporary, path)
        finally:
            Path(temporary).unlink(missing_ok=True)
    except OSError as error:
        raise write_error(path, error) from None


def write_error(path: Path, error: OSError) -> BadInput:
    """Return the error for a file or folder that could not be written. For a full disk it states the free space.

    Call it after removing partial files, which also occupy space.
    """
    free = ""
    if error.errno in (ENOSPC, EDQUOT):
        with suppress(OSError):  # the folder no longer exists
            free = f", {shutil.disk_usage(path.parent).free / 1e6:.1f} MB are free there"
    return BadInput(f"cannot write {str(path)!r}: {error.strerror or error}{free}")
