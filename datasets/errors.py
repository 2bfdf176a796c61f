"""The one error that is the user's to mend."""

from __future__ import annotations

import shutil
from contextlib import suppress
from errno import EDQUOT, ENOSPC
from pathlib import Path


class BadInput(ValueError):
    """Something given from outside cannot be used: a name, a file, a shape, a value.

    The message is one line that says what is wrong, with the value, and what would be right. The command line prints
    it and exits with 2; the page shows it (4xx, JSON).
    """


def one_of(kind: str, name: str, available: object) -> BadInput:
    """The error for an unknown name: ``filter 'crosmodal-pf' does not exist. Available: ...``."""
    names = ", ".join(str(a) for a in available)  # type: ignore[attr-defined]
    return BadInput(f"{kind} {name!r} does not exist. Available: {names or 'none'}.")


def unwritable(path: Path, error: OSError) -> BadInput:
    """The error for a file or folder that could not be written; of a full disk, with what is free there.

    To be asked for once what was half written is gone, since that is free again.
    """
    free = ""
    if error.errno in (ENOSPC, EDQUOT):
        with suppress(OSError):  # the folder has gone as well
            free = f", {shutil.disk_usage(path.parent).free / 1e6:.1f} MB are free there"
    return BadInput(f"cannot write {str(path)!r}: {error.strerror or error}{free}")
