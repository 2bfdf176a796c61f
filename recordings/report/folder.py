"""The folder of a report: written completely or not at all; replaces nothing but an existing report."""

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
"""Format in the manifest of a report."""


def check_folder(folder: Path) -> None:
    """Raise BadInput if a report cannot be written to the folder: it must be new, empty, or contain a report."""
    if folder.is_file():
        raise BadInput(f"{str(folder)!r} is a file; give the name of a folder")
    if not folder.absolute().parent.is_dir():
        raise BadInput(f"folder {str(folder.parent)!r} does not exist, so {folder.name!r} cannot be created")
    if folder.is_dir() and any(folder.iterdir()) and not _is_report(folder):
        raise BadInput(f"folder {str(folder)!r} contains something other than a report; give another name")


def _is_report(folder: Path) -> bool:
    try:
        manifest = json.loads((folder / "manifest.json").read_bytes())
    except (OSError, ValueError):
        return False
    return isinstance(manifest, dict) and str(manifest.get("format", "")).startswith(FAMILY)


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Yields a hidden folder next to it, renamed at the end or removed on errors."""
    folder = Path(folder).absolute()
    check_folder(folder)
    with _locked(folder.parent):  # no cleanup between creating and locking the folder
        _clean_up(folder)
        temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        lock = ExitStack()
        lock.enter_context(_locked(temporary))
    old = temporary.with_name(f"{temporary.name}.old")
    try:
        yield temporary
        os.chmod(temporary, 0o755)
        check_folder(folder)  # it may have changed in the meantime
        if folder.exists():
            folder.rename(old)
        try:
            temporary.rename(folder)
        except OSError:
            if old.exists():
                old.rename(folder)
            raise
    finally:
        lock.close()
        shutil.rmtree(temporary, ignore_errors=True)
    shutil.rmtree(old, ignore_errors=True)


def _clean_up(folder: Path) -> None:
    """Remove folders of killed processes. Restore the old report if one was killed between its two renames."""
    for temporary in folder.parent.glob(f".{glob.escape(folder.name)}.????????"):
        with suppress(OSError), _locked(temporary, wait=False):  # folders in use are locked
            shutil.rmtree(temporary)
    for old in folder.parent.glob(f".{glob.escape(folder.name)}.????????.old"):
        with suppress(OSError):
            if folder.exists():
                shutil.rmtree(old)
            else:
                old.rename(folder)


@contextmanager
def _locked(folder: Path, wait: bool = True) -> Iterator[None]:
    """Lock a folder; released when the process ends. Raises OSError if it is locked and ``wait`` is false."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(handle)
