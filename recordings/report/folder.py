"""A report's folder: there as a whole or not at all, and nothing but an older report is ever replaced by it."""

from __future__ import annotations

import fcntl
import glob
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from beliefscope.datasets.errors import BadInput

FAMILY = "beliefscope-report "
FORMAT = f"{FAMILY}1"
"""What a report's manifest says that it is."""


def check_folder(folder: Path) -> None:
    """Raises BadInput where a report must not be written: only an older report may be replaced."""
    if folder.is_file():
        raise BadInput(f"{str(folder)!r} is a file; give the name of a folder")
    if not folder.absolute().parent.is_dir():
        raise BadInput(f"folder {str(folder.parent)!r} does not exist, so {folder.name!r} cannot be made in it")
    if folder.is_dir() and any(folder.iterdir()) and not _is_report(folder):
        raise BadInput(f"folder {str(folder)!r} holds something else than a report; give another name")


def _is_report(folder: Path) -> bool:
    try:
        found = json.loads((folder / "manifest.json").read_bytes())
    except (OSError, ValueError):
        return False
    return isinstance(found, dict) and str(found.get("format", "")).startswith(FAMILY)


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """A hidden folder beside it, which takes its name when all went well, and is gone when not."""
    folder = Path(folder).absolute()
    check_folder(folder)
    with _held(folder.parent):  # so that nobody clears away what is not held yet
        _clear(folder)
        made = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        holding = ExitStack()
        holding.enter_context(_held(made))
    old = made.with_name(f"{made.name}.old")
    try:
        yield made
        os.chmod(made, 0o755)
        check_folder(folder)  # it may have become something else meanwhile
        if folder.exists():
            folder.rename(old)
        try:
            made.rename(folder)
        except OSError:
            if old.exists():
                old.rename(folder)
            raise
    finally:
        holding.close()
        shutil.rmtree(made, ignore_errors=True)
    shutil.rmtree(old, ignore_errors=True)


def _clear(folder: Path) -> None:
    """Removes what reports left there that were killed; one killed between its two renames leaves the older report."""
    for left in folder.parent.glob(f".{glob.escape(folder.name)}.????????"):
        with suppress(OSError), _held(left, wait=False):  # one that is being written is held
            shutil.rmtree(left)
    for old in folder.parent.glob(f".{glob.escape(folder.name)}.????????.old"):
        with suppress(OSError):
            if folder.exists():
                shutil.rmtree(old)
            else:
                old.rename(folder)


@contextmanager
def _held(folder: Path, wait: bool = True) -> Iterator[None]:
    """Holds a folder among all who ask so; a process that ends lets go. Raises OSError for one that is held."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(handle)
