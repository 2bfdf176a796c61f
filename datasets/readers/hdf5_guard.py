"""Protection against libhdf5 failures on damaged files and full disks.

Some damaged files make libhdf5 loop forever (version 2.0, a wrong size in a heap of strings), which Python cannot
interrupt. A subprocess therefore probes each external file once (``python -m beliefscope.datasets.readers.hdf5_guard``)
and only files that it survives are opened. A failed write makes libhdf5 crash the process at exit;
``DeferredErrorFile`` hides the error from libhdf5 and reports it afterwards.
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

HDF5_ERRORS = (OSError, RuntimeError, KeyError, ValueError, TypeError, OverflowError)
"""Exceptions of h5py for a damaged file. BadInput is a ValueError too."""

SAMPLES = Path(__file__).resolve().parents[1] / "samples"
"""Files distributed with the package are not probed."""

SECONDS = 5.0
SECONDS_PER_MB = 1.0
"""Limit of processor time for probing a file. Typical files take 0.1 s per MB, empty groups 0.25 s per MB."""

MEMORY = 1 << 32
"""Limit of address space for probing a file, bytes."""

_readable: dict[tuple[int, int, int, int], bool] = {}
"""Device, inode, size and modification time -> whether the probe of the file finished."""


def open_hdf5(path: Path) -> h5py.File:
    """Open a file for reading. Raises BadInput if it is missing, not HDF5 or damaged."""
    if not path.exists():
        raise BadInput(f"{path} does not exist.")
    if not path.is_file():
        raise BadInput(f"{path} is not a file.")
    probe([path])
    if not _readable.get(_identity(path), True):
        limit = f"{SECONDS + SECONDS_PER_MB * path.stat().st_size / 1e6:.0f} s"
        raise BadInput(f"{path} cannot be read as HDF5 within {limit}: it is damaged. Collect or copy it again.")
    try:
        return h5py.File(path, "r")
    except PermissionError:
        raise BadInput(f"No permission to read {path}.") from None
    except HDF5_ERRORS as error:
        if not h5py.is_hdf5(path):
            known = path.suffix.lower() in (".h5", ".hdf5", ".safetensors")
            hint = "" if known else "; beliefscope import reads logs in other formats"
            raise BadInput(f"{path} is not an HDF5 file{hint}.") from None
        raise read_error(path, error) from None


def probe(paths: Iterable[Path]) -> None:
    """Test in a subprocess which external files can be read. One process probes all files up to a fatal one."""
    pending = [path for path in paths if _identity(path) not in _readable and needs_probe(path)]
    while pending:
        process = subprocess.run(
            [sys.executable, "-P", "-m", "beliefscope.datasets.readers.hdf5_guard", str(SECONDS)],
            input=b"\0".join(os.fsencode(path) for path in pending),
            capture_output=True,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
            check=False,
        )
        assert process.returncode <= 0, process.stderr.decode(errors="replace")
        finished = len(process.stdout)
        for index, path in enumerate(pending[: finished + 1]):
            _readable[_identity(path)] = index < finished
        pending = pending[finished + 1 :]


def mark_readable(path: Path) -> None:
    """Skip the probe of a file written by this process."""
    _readable[_identity(path)] = True


def needs_probe(path: Path) -> bool:
    """Whether the file is HDF5 and not distributed with the package."""
    return not path.resolve().is_relative_to(SAMPLES) and path.is_file() and bool(h5py.is_hdf5(path))


def _identity(path: Path) -> tuple[int, int, int, int]:
    with suppress(OSError):
        status = path.stat()
        return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns
    return 0, 0, 0, 0


def read_error(path: Path, error: Exception) -> BadInput:
    """Return the error for a file that HDF5 cannot read, with its message."""
    return BadInput(f"{path} is damaged or truncated: {error_message(error)}. Collect or copy it again.")


def error_message(error: Exception) -> str:
    """Message of an HDF5 error in one line."""
    return " ".join((getattr(error, "strerror", None) or str(error)).split()).strip(" '\".")


class DeferredErrorFile(io.FileIO):
    """Output file for libhdf5 that reports every write as successful; ``check`` raises the first error.

    Attributes:
        error: the first error. Later writes are discarded.
    """

    error: OSError | None = None

    def write(self, data: Any, /) -> int:
        remaining = memoryview(data)
        size = remaining.nbytes
        try:
            while self.error is None and remaining.nbytes:
                remaining = remaining[super().write(remaining) :]
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
        """Raise the first error, if any."""
        if self.error is not None:
            raise self.error


def _traverse(path: str) -> None:
    """Access everything a reader may access: names, attributes, types, shapes and chunk indices."""
    with h5py.File(path, "r") as file:
        pending: list[Any] = [file]
        visited = set()
        while pending:
            item = pending.pop()
            with suppress(*HDF5_ERRORS):
                info = h5py.h5o.get_info(item.id)
                if (info.fileno, info.addr) in visited:  # links may form cycles
                    continue
                visited.add((info.fileno, info.addr))
            for name in _names(item.attrs):
                with suppress(*HDF5_ERRORS):
                    item.attrs.get(name)
            if isinstance(item, h5py.Dataset):
                with suppress(*HDF5_ERRORS):
                    item.id.get_storage_size()  # reads the chunk index
            for name in _names(item) if isinstance(item, h5py.Group) else ():
                with suppress(*HDF5_ERRORS):
                    if (member := item.get(name)) is not None:
                        pending.append(member)


def _names(container: Iterable[str]) -> list[str]:
    with suppress(*HDF5_ERRORS):
        return list(container)
    return []


def main() -> None:
    """Entry point of the subprocess: write a byte to standard output after each file. A fatal file ends it."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _, limit = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY if limit == resource.RLIM_INFINITY else min(MEMORY, limit), limit))
    for path in sys.stdin.buffer.read().split(b"\0"):
        try:
            seconds = float(sys.argv[1]) + SECONDS_PER_MB * os.stat(path).st_size / 1e6
            signal.setitimer(signal.ITIMER_PROF, seconds)  # SIGPROF ends the process
            _traverse(os.fsdecode(path))
        except HDF5_ERRORS:
            pass
        except MemoryError:
            signal.raise_signal(signal.SIGKILL)
        os.write(1, b".")


if __name__ == "__main__":
    main()
