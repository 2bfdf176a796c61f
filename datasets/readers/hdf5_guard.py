"""HDF5 files of others, and a full disk: what libhdf5 does not take well.

Some damaged files lead libhdf5 round in circles (version 2.0 in a heap of strings, one of whose sizes is wrong), and
nothing of Python's gets in between. So another process reads a file first
(``python -m beliefscope.datasets.readers.hdf5_guard``), and this one opens only the files which that process
survived. Where libhdf5 cannot write a file to its end, it crashes the process at exit: ``Sink`` hides the error from
libhdf5 and reports it.
"""

from __future__ import annotations

import io
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py

from beliefscope.datasets.errors import BadInput

DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError)
"""What h5py raises on meeting a damaged file. BadInput is a ValueError too."""

SHIPPED = Path(__file__).resolve().parents[1] / "samples"
"""What lies there was looked at before it was shipped."""

SECONDS = 5.0
SECONDS_A_MB = 1.0
"""Of processor, that looking over one file may take. One of ours takes 0.1 s a MB, one of empty groups alone 0.25 s."""

MEMORY = 1 << 32
"""Bytes of addresses, that looking over one file may take."""

_came_back: dict[tuple[int, int, int, int], bool] = {}
"""Device, inode, size and time of change -> whether a process comes back from that file."""


def open_hdf5(path: Path) -> h5py.File:
    """For reading. Raises BadInput where it is missing, no HDF5, or damaged so that it cannot even be looked over."""
    if not path.exists():
        raise BadInput(f"{path} does not exist.")
    if not path.is_file():
        raise BadInput(f"{path} is not a file.")
    look_over([path])
    if not _came_back.get(_identity(path), True):
        most = f"{SECONDS + SECONDS_A_MB * path.stat().st_size / 1e6:.0f} s"
        raise BadInput(f"{path} cannot be read as HDF5 within {most}: it is damaged. Collect or copy it again.")
    try:
        return h5py.File(path, "r")
    except PermissionError:
        raise BadInput(f"No permission to read {path}.") from None
    except DAMAGE as error:
        if not h5py.is_hdf5(path):
            raise BadInput(f"{path} is not an HDF5 file.") from None
        raise damaged(path, error) from None


def look_over(paths: Iterable[Path]) -> None:
    """Finds out which files a process comes back from: all in one, where one has to be started at all."""
    waiting = [path for path in paths if _identity(path) not in _came_back and is_foreign(path)]
    while waiting:
        process = subprocess.run(
            [sys.executable, "-P", "-m", "beliefscope.datasets.readers.hdf5_guard", str(SECONDS)],
            input=b"\0".join(os.fsencode(path) for path in waiting),
            capture_output=True,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
            check=False,
        )
        assert process.returncode <= 0, process.stderr.decode(errors="replace")
        done = len(process.stdout)
        for path in waiting[:done]:
            trust(path)
        for path in waiting[done : done + 1]:
            _came_back[_identity(path)] = False
        waiting = waiting[done + 1 :]


def trust(path: Path) -> None:
    """Of a file that this process has written, or another came back from."""
    _came_back[_identity(path)] = True


def is_foreign(path: Path) -> bool:
    """Whether it is HDF5, and not of those that ship."""
    return not path.resolve().is_relative_to(SHIPPED) and path.is_file() and bool(h5py.is_hdf5(path))


def _identity(path: Path) -> tuple[int, int, int, int]:
    with suppress(OSError):
        status = path.stat()
        return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns
    return 0, 0, 0, 0


def damaged(path: Path, error: Exception) -> BadInput:
    """The error for a file that HDF5 cannot read, with its own words."""
    return BadInput(f"{path} is damaged or cut short: {reason(error)}. Collect or copy it again.")


def reason(error: Exception) -> str:
    """HDF5's own words, in one line."""
    return " ".join((getattr(error, "strerror", None) or str(error)).split()).strip(" '\".")


class Sink(io.FileIO):
    """A file for libhdf5 to write to, which takes all it is given; what it could not write it says at its end.

    Attributes:
        error: the first one, after which nothing is written any more.
    """

    error: OSError | None = None

    def write(self, data: Any, /) -> int:
        left = memoryview(data)
        size = left.nbytes
        try:
            while self.error is None and left.nbytes:
                left = left[super().write(left) :]
        except OSError as error:
            self.error = error
        return size

    def truncate(self, size: int | None = None, /) -> int:
        try:
            return super().truncate(size) if self.error is None else 0
        except OSError as error:
            self.error = error
            return 0

    def check(self) -> None:
        """Raises the OSError that was met."""
        if self.error is not None:
            raise self.error


def _look(path: str) -> None:
    """Goes wherever a reader of ours may go: all names, attributes, types, shapes, and indices of chunks."""
    with h5py.File(path, "r") as file:
        waiting: list[Any] = [file]
        seen = set()
        while waiting:
            one = waiting.pop()
            with suppress(*DAMAGE):
                place = h5py.h5o.get_info(one.id)
                if (place.fileno, place.addr) in seen:  # links may lead round too
                    continue
                seen.add((place.fileno, place.addr))
            for name in _names(one.attrs):
                with suppress(*DAMAGE):
                    one.attrs.get(name)
            if isinstance(one, h5py.Dataset):
                with suppress(*DAMAGE):
                    one.id.get_storage_size()  # walks over its chunks
            for name in _names(one) if isinstance(one, h5py.Group) else ():
                with suppress(*DAMAGE):
                    if (member := one.get(name)) is not None:
                        waiting.append(member)


def _names(of: Iterable[str]) -> list[str]:
    with suppress(*DAMAGE):
        return list(of)
    return []


def main() -> None:
    """In the process: a byte on standard output for each file that it came back from. A signal ends it at another."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY if most == resource.RLIM_INFINITY else min(MEMORY, most), most))
    for path in sys.stdin.buffer.read().split(b"\0"):
        try:
            patience = float(sys.argv[1]) + SECONDS_A_MB * os.stat(path).st_size / 1e6
            signal.setitimer(signal.ITIMER_PROF, patience)  # SIGPROF ends a process that does not care
            _look(os.fsdecode(path))
        except DAMAGE:
            pass
        except MemoryError:
            signal.raise_signal(signal.SIGKILL)
        os.write(1, b".")


if __name__ == "__main__":
    main()
