"""Files that are written whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from contextlib import suppress
from errno import EDQUOT, ENOSPC
from pathlib import Path

from beliefscope.datasets.errors import BadInput


def write_atomically(path: Path, data: bytes) -> None:
    """The old file or the new one, never half of it. Raises BadInput where it cannot be written: no folder, no room."""
    path = Path(path)
    try:
        if not path.parent.is_dir():
            raise BadInput(f"folder {str(path.parent)!r} does not exist")
        handle, temporary = tempfile.mkstemp(".part", f".{path.name[:100]}.", path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.chmod(temporary, 0o644)
            os.replace(temporary, path)
        finally:
            Path(temporary).unlink(missing_ok=True)
    except OSError as error:
        raise unwritable(path, error) from None


def unwritable(path: Path, error: OSError) -> BadInput:
    """The error for a file or folder that could not be written; of a full disk, with what is free there.

    To be asked for once what was half written is gone, since that is free again.
    """
    free = ""
    if error.errno in (ENOSPC, EDQUOT):
        with suppress(OSError):  # the folder has gone as well
            free = f", {shutil.disk_usage(path.parent).free / 1e6:.1f} MB are free there"
    return BadInput(f"cannot write {str(path)!r}: {error.strerror or error}{free}")
