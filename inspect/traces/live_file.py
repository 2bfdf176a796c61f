"""Append-only trace file ``NAME.live``, written while a filter runs.

    marker, length and checksum of the header | header, JSON | static arrays
    marker, rows and checksum of a block | the steps of the block, array by array in C order
    ...
    end marker

If the writer is killed, at most the current block is lost. Readers poll the file size and read new blocks; writer and
readers share nothing but the file. Numbers are little-endian; checksums are CRC-32.
"""

from __future__ import annotations

import fcntl
import json
import math
import os
import re
import struct
import threading
from array import array as packed
from bisect import bisect_right
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import write_error
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.datasets.task import Task
from beliefscope.inspect.traces.data import STATIC, Trace, arrays_of
from beliefscope.inspect.traces.file import header_of, trace_from_arrays

FORMAT = 1
SUFFIX = ".live"
LARGEST_HEADER = 1 << 24
LARGEST_STEP = 1 << 26
LARGEST_BLOCK = 1 << 27
"""Bytes; limits on the sizes that a damaged file may claim."""

MARKER = struct.Struct("<4sII")
HEADER, STEPS, END = b"BsL\n", b"step", b"end\n"

Arrays = dict[str, NDArray[Any]]
Shapes = dict[str, tuple[tuple[int, ...], np.dtype[Any]]]
"""Array -> shape and dtype of one step, or of the whole array if it has no step axis."""


def unused_path(folder: Path, name: str) -> Path:
    """The first unused of NAME, NAME-2, NAME-3, ..."""
    number, path = 1, folder / f"{name}{SUFFIX}"
    while path.exists():
        number += 1
        path = folder / f"{name}-{number}{SUFFIX}"
    return path


def check_run_name(name: str) -> None:
    """Raise BadInput for a name that is not the name of a file in the folder of live runs."""
    if Path(name).name != name or name.startswith("."):
        raise BadInput(
            f"{name!r} is not the name of a live run: give a file name, without a folder and not starting with a dot. "
            "--workspace chooses the folder (in Python, folder=)."
        )


class LiveFileWriter:
    """Writer of a live file. Use one writer per file, from one thread.

    Attributes:
        path: file path.
        steps: number of written steps.
    """

    def __init__(self, path: Path, like: Trace, expected: int | None = None) -> None:
        """Create the file and lock it until this writer, or its process, ends.

        Args:
            like: template trace of any length: array shapes and dtypes, static arrays and metadata. Its steps are not
                written.
            expected: expected number of steps, if known.

        Raises:
            BadInput: the file exists or cannot be written.
        """
        self.path, self.steps = Path(path), 0
        arrays = arrays_of(like)
        static = {name: np.ascontiguousarray(arrays.pop(name)) for name in STATIC}
        self._shapes = _shapes_of_step(arrays)
        header = {
            "format": FORMAT,
            "trace": header_of(like),
            "arrays": _shapes_to_json(self._shapes),
            "static": _shapes_to_json({name: (array.shape, array.dtype) for name, array in static.items()}),
            "expected": expected,
            "pid": os.getpid(),
            "started": datetime.now(UTC).isoformat(timespec="seconds"),
        }
        # Computed first, because a reader may find the file as soon as it exists.
        content = json.dumps(header).encode() + b"".join(array.tobytes() for array in static.values())
        try:
            self._file = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise write_error(self.path, error) from None
        fcntl.flock(self._file, fcntl.LOCK_EX)
        self._size = 0
        self._write(HEADER, len(content), content)

    def append(self, part: Trace) -> None:
        """Append the steps of a trace. Raises BadInput if its arrays differ from the template or the disk is full."""
        arrays = {name: array for name, array in arrays_of(part).items() if name not in STATIC}
        new_shapes = _shapes_of_step(arrays)
        for name in self._shapes | new_shapes:
            new, expected = (_shape_text(shapes.get(name)) for shapes in (new_shapes, self._shapes))
            if new != expected:
                raise BadInput(f"step {self.steps} has {name} as {new}, the run started with {expected}")
        block = max(1, LARGEST_BLOCK // max(1, _bytes(self._shapes)))
        for first in range(0, len(part), block):
            rows = {name: np.ascontiguousarray(arrays[name][first : first + block]) for name in self._shapes}
            count = min(block, len(part) - first)
            self._write(STEPS, count, b"".join(array.tobytes() for array in rows.values()))
            self.steps += count

    def finish(self) -> None:
        """Write the end marker and close the file."""
        self._write(END, self.steps, b"")
        os.fsync(self._file)
        self.close()

    def close(self) -> None:
        """Close the file without an end marker. May be called repeatedly."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _write(self, marker: bytes, number: int, content: bytes) -> None:
        data = memoryview(MARKER.pack(marker, number, _checksum(marker, number, content)) + content)
        try:
            at = self._size
            while at < self._size + len(data):
                at += os.pwrite(self._file, data[at - self._size :], at)
        except OSError as error:
            os.ftruncate(self._file, self._size)  # removes the partial block, so that later blocks can be read
            raise write_error(self.path, error) from None
        self._size = at


class LiveFileReader:
    """Reader of a live file that may still grow. Methods may be called from any thread.

    Attributes:
        path: file path.
        steps: complete steps at the last ``poll``; 0 before the first.
        finished: whether the end marker had been written at the last ``poll``.
        expected: expected number of steps; None if unknown.
        started: ISO 8601 start time.
        pid: process ID of the writer.
        bytes_per_step: size of a step in the file.
    """

    def __init__(self, path: Path, given: Iterable[Task] = ()) -> None:
        """Raises BadInput if the file is missing, truncated within the header, or not a live file.

        Args:
            given: user-defined tasks, as for ``stored_task``.
        """
        self.path, self._given = Path(path), tuple(given)
        self.steps, self.finished = 0, False
        if not self.path.is_file():
            raise BadInput(f"live run {self._name} does not exist")
        try:
            self._file = os.open(self.path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise BadInput(f"{self._name} cannot be read: {error.strerror}") from None
        self._lock = threading.RLock()
        self._read_steps = 0  # steps returned by ``read``
        self._firsts, self._offsets = packed("q"), packed("q")  # first step and file offset of each block
        try:
            self._read_header()
        except BaseException:
            self.close()
            raise

    @property
    def _name(self) -> str:
        return repr(str(self.path))

    @property
    def alive(self) -> bool:
        """Whether the writer is still running: no end marker, and the file is locked.

        After this is False, one more ``poll`` finds all remaining steps. A process that the writer forked and that
        outlives it counts as the writer.
        """
        if self.finished:
            return False
        with self._lock:
            try:
                fcntl.flock(self._file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except OSError:
                return True
            fcntl.flock(self._file, fcntl.LOCK_UN)
        return False

    def poll(self) -> int:
        """Check the file for new steps and verify them. Returns the total number of steps.

        Raises BadInput if the file is damaged; earlier steps stay readable.
        """
        with self._lock:
            size = os.fstat(self._file).st_size
            if size < self._end:
                raise BadInput(f"{self._name} was truncated during reading, after step {self.steps}")
            while not self.finished and size - self._end >= MARKER.size and self._next(size):
                pass
            return self.steps

    def read(self) -> Trace:
        """Poll, and return the steps since the last call as a trace, which may be empty."""
        with self._lock:
            first, self._read_steps = self._read_steps, self.poll()
            return self.part(first, self._read_steps)

    def part(self, first: int = 0, last: int | None = None, stride: int = 1) -> Trace:
        """Read steps ``first`` to ``last - 1`` of the polled steps, by default all, or every ``stride``-th step.

        Raises BadInput for steps outside the file.
        """
        with self._lock:
            last = self.steps if last is None else last
            if not 0 <= first <= last <= self.steps:
                raise BadInput(f"steps {first} to {last} are not in {self._name}: it has {self.steps}")
            steps = range(first, last, stride)
            arrays = {name: np.empty((len(steps), *shape), dtype) for name, (shape, dtype) in self._shapes.items()}
            if stride == 1:
                self._fill(arrays, first, last)
            for at, step in enumerate(steps if stride > 1 else ()):
                self._fill({name: array[at : at + 1] for name, array in arrays.items()}, step, step + 1)
            return self._trace(arrays)

    def close(self) -> None:
        """Close the file. Returned traces stay valid. May be called repeatedly."""
        with self._lock:
            if self._file >= 0:
                os.close(self._file)
                self._file = -1

    def _read_header(self) -> None:
        marker, length, checksum = MARKER.unpack(self._bytes_at(0, MARKER.size).ljust(MARKER.size, b"\0"))
        if marker != HEADER:
            raise BadInput(f"{self._name} is not a Beliefscope live run")
        content = self._bytes_at(MARKER.size, length) if length <= LARGEST_HEADER else b""
        if _checksum(marker, length, content) != checksum:
            raise BadInput(f"{self._name} has an incomplete header")
        try:
            _, end = json.JSONDecoder().raw_decode(content.decode("latin-1"))
            header = read_json(content[:end])
            if header["format"] != FORMAT:
                raise BadInput(f"{self._name} has live format {header['format']}; this version reads format {FORMAT}")
            self._shapes, static = _shapes(header["arrays"]), _shapes(header["static"])
            self._row = _bytes(self._shapes)
            if self._row > LARGEST_STEP or _bytes(static) != length - end:
                raise ValueError(f"{self._row} bytes per step")
            self._static = {name: array.copy() for name, array in _split(content[end:], static, None).items()}
            self._header = header["trace"]
            self.expected, self.started, self.pid = header["expected"], str(header["started"]), int(header["pid"])
            if self.expected is not None and (type(self.expected) is not int or self.expected < 0):
                raise ValueError(f"expected number of steps is {self.expected!r}")
            self._trace({name: np.empty((0, *shape), dtype) for name, (shape, dtype) in self._shapes.items()})
        except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
            raise BadInput(f"{self._name} has an invalid header: {error}") from None
        self.bytes_per_step = self._row
        self._end = MARKER.size + length

    def _next(self, size: int) -> bool:
        """Index the next block if it is complete."""
        marker, rows, checksum = MARKER.unpack(self._bytes_at(self._end, MARKER.size))
        length = rows * self._row if marker == STEPS else 0
        end = self._end + MARKER.size + length
        damaged = marker not in (STEPS, END) or length > max(LARGEST_BLOCK, self._row)
        if not damaged and end > size:
            return False  # being written, or incomplete because the writer ended
        if damaged or _checksum(marker, rows, self._bytes_at(self._end + MARKER.size, length)) != checksum:
            if not damaged and end == size:
                return False
            raise BadInput(f"{self._name} is damaged after step {self.steps}")
        if marker == END:
            self.finished = True
        else:
            self._firsts.append(self.steps)
            self._offsets.append(self._end + MARKER.size)
            self.steps += rows
        self._end = end
        return True

    def _fill(self, arrays: Arrays, first: int, last: int) -> None:
        """Read steps ``first`` to ``last - 1`` into arrays of that length."""
        number = bisect_right(self._firsts, first) - 1
        at = first
        while at < last:
            start, offset = self._firsts[number], self._offsets[number]
            stop = self._firsts[number + 1] if number + 1 < len(self._firsts) else self.steps
            rows = _split(self._bytes_at(offset, (stop - start) * self._row), self._shapes, stop - start)
            to = min(stop, last)
            for name, array in arrays.items():
                array[at - first : to - first] = rows[name][at - start : to - start]
            at, number = to, number + 1

    def _trace(self, arrays: Arrays) -> Trace:
        return trace_from_arrays(self._header, arrays | self._static, self._given)

    def _bytes_at(self, offset: int, length: int) -> bytes:
        parts = []
        while length and (part := os.pread(self._file, length, offset)):
            parts.append(part)
            offset, length = offset + len(part), length - len(part)
        return b"".join(parts)


def load_live(path: Path, given: Iterable[Task] = ()) -> Trace:
    """Read all complete steps. Raises BadInput as ``LiveFileReader``, and if the file is damaged or has no step."""
    reader = LiveFileReader(path, given)
    try:
        if not reader.poll():
            raise BadInput(f"{str(path)!r} has no step yet")
        return reader.part()
    finally:
        reader.close()


def _checksum(marker: bytes, number: int, content: bytes) -> int:
    return crc32(content, crc32(struct.pack("<4sI", marker, number)))


def _shapes_of_step(arrays: Mapping[str, NDArray[Any]]) -> Shapes:
    return {name: (array.shape[1:], array.dtype) for name, array in arrays.items()}


def _shape_text(entry: tuple[tuple[int, ...], np.dtype[Any]] | None) -> str:
    return "missing" if entry is None else f"{entry[1]} {entry[0]}"


def _shapes_to_json(shapes: Shapes) -> dict[str, Any]:
    return {name: [list(shape), dtype.str] for name, (shape, dtype) in shapes.items()}


def _shapes(values: Mapping[str, Any]) -> Shapes:
    """Inverse of ``_shapes_to_json``. Raises ValueError or TypeError for invalid dtypes and shapes."""
    shapes: Shapes = {}
    for name, (shape, dtype) in values.items():
        numeric = re.fullmatch(r"[<>|][biuf]\d{1,2}", dtype)
        if not numeric or not all(type(size) is int and size >= 0 for size in shape):
            raise ValueError(f"{name[:100]!r} of type {dtype[:100]!r} and shape {str(shape)[:100]}")
        shapes[name] = tuple(shape), np.dtype(dtype)
    return shapes


def _bytes(shapes: Shapes) -> int:
    return sum(math.prod(shape) * dtype.itemsize for shape, dtype in shapes.values())


def _split(content: bytes, shapes: Shapes, rows: int | None) -> Arrays:
    """Consecutive arrays in ``content``: of ``rows`` steps, or static arrays if ``rows`` is None."""
    arrays, at = {}, 0
    for name, (shape, dtype) in shapes.items():
        full = shape if rows is None else (rows, *shape)
        arrays[name] = np.frombuffer(content, dtype, math.prod(full), at).reshape(full)
        at += arrays[name].nbytes
    return arrays


def write_live(trace: Trace, path: Path) -> None:
    """Write a trace as the file of a live run that has ended, atomically."""
    part = path.with_name(f".{path.name[:60]}.part")  # names have 255 bytes at most
    part.unlink(missing_ok=True)
    writer = LiveFileWriter(part, trace, len(trace))
    try:
        writer.append(trace)
        writer.finish()
        part.replace(path)
    finally:
        writer.close()
        part.unlink(missing_ok=True)
