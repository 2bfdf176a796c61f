"""A trace that grows on disk while its filter runs: ``NAME.live``, to which steps are only ever added.

    mark, length and checksum of the header | header, JSON | what is not over steps
    mark, rows and checksum of a block | that many whole steps, array by array in C order
    ...
    the end's mark

A writer that is killed loses at most the block under way. A reader looks at the file's size and reads what is new: the
file is the queue between them, and the writer knows of no reader. Numbers are little-endian; checksums are CRC-32.
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
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import unwritable
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.inspect.trace import Trace, arrays_of, header_of, trace_of

FORMAT = 1
SUFFIX = ".live"
STATIC = ("start_mean", "start_covariance")
"""Arrays of a trace that are not over steps."""

LARGEST_HEADER = 1 << 24
LARGEST_STEP = 1 << 26
LARGEST_BLOCK = 1 << 27
"""Bytes. No filter of this world comes near; a damaged file may claim anything."""

MARK = struct.Struct("<4sII")
HEADER, STEPS, END = b"BsL\n", b"step", b"end\n"

Arrays = dict[str, NDArray[Any]]
Shapes = dict[str, tuple[tuple[int, ...], np.dtype[Any]]]
"""Array -> shape and type of one step; of the whole where it is not over steps."""


class GrowingWriter:
    """Writes steps as they come. One file has one writer, in one thread.

    Attributes:
        path: of the file. steps: that are in it.
    """

    def __init__(self, path: Path, like: Trace, expected: int | None = None) -> None:
        """Makes the file. It is locked until this writer, or its process, has ended.

        Args:
            like: a trace of any length, to which those that are appended belong: its arrays' shapes and types, and all
                that is not over steps. None of its steps is written.
            expected: how many steps there will be, where that is known.

        Raises:
            BadInput: there is a file of that name, or it cannot be written.
        """
        self.path, self.steps = Path(path), 0
        arrays = arrays_of(like)
        static = {name: np.ascontiguousarray(arrays.pop(name)) for name in STATIC}
        self._shapes = _shapes_of_step(arrays)
        header = {
            "format": FORMAT,
            "trace": header_of(like),
            "arrays": _described(self._shapes),
            "static": _described({name: (array.shape, array.dtype) for name, array in static.items()}),
            "expected": expected,
            "pid": os.getpid(),
            "started": datetime.now(UTC).isoformat(timespec="seconds"),
        }
        try:
            self._file = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise unwritable(self.path, error) from None
        fcntl.flock(self._file, fcntl.LOCK_EX)
        self._size = 0
        content = json.dumps(header).encode() + b"".join(array.tobytes() for array in static.values())
        self._write(HEADER, len(content), content)

    def append(self, part: Trace) -> None:
        """Adds the steps of a trace. Raises BadInput where its arrays are not as at the start, or the disk is full."""
        arrays = {name: array for name, array in arrays_of(part).items() if name not in STATIC}
        found = _shapes_of_step(arrays)
        for name in self._shapes | found:
            now, before = (_told(shapes.get(name)) for shapes in (found, self._shapes))
            if now != before:
                raise BadInput(f"step {self.steps} has {name} as {now}, the run began with {before}")
        most = max(1, LARGEST_BLOCK // max(1, _bytes(self._shapes)))
        for first in range(0, len(part), most):
            rows = {name: np.ascontiguousarray(arrays[name][first : first + most]) for name in self._shapes}
            count = min(most, len(part) - first)
            self._write(STEPS, count, b"".join(array.tobytes() for array in rows.values()))
            self.steps += count

    def finish(self) -> None:
        """Says that there are all, and closes the file."""
        self._write(END, self.steps, b"")
        os.fsync(self._file)
        self.close()

    def close(self) -> None:
        """Closes the file without an end, as a kill would. May be called again."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _write(self, mark: bytes, number: int, content: bytes) -> None:
        data = memoryview(MARK.pack(mark, number, _checksum(mark, number, content)) + content)
        try:
            at = self._size
            while at < self._size + len(data):
                at += os.pwrite(self._file, data[at - self._size :], at)
        except OSError as error:
            os.ftruncate(self._file, self._size)  # so that what is written once there is room again can be read
            raise unwritable(self.path, error) from None
        self._size = at


class GrowingReader:
    """Reads a file that may still grow. Its methods may be called from any thread.

    Attributes:
        path: of the file. steps: complete ones, as of the last ``poll``; 0 before the first. finished: whether it has
            its end by then.
        expected: how many there will be; None where that is not known. started: ISO 8601. pid: of the writer.
        bytes_per_step: in the file.
    """

    def __init__(self, path: Path) -> None:
        """Raises BadInput for what is missing, cut off within its header, or not such a file."""
        self.path = Path(path)
        self.steps, self.finished = 0, False
        if not self.path.is_file():
            raise BadInput(f"live run {self._name} does not exist")
        try:
            self._file = os.open(self.path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise BadInput(f"{self._name} cannot be read: {error.strerror}") from None
        self._lock = threading.RLock()
        self._given = 0  # steps that ``read`` has given
        self._firsts, self._places = packed("q"), packed("q")  # each block's first step, its place in the file
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
        """Whether more may come: the file has no end yet, and its writer still lives.

        One that was killed leaves no end. ``poll`` after this has said False finds everything there will ever be.
        A process that the writer's forked, and that outlives it, counts as the writer.
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
        """Looks for new steps, and checks them; costs little where there are none. Returns how many there are in all.

        Raises BadInput where the file is damaged. The steps before that stay readable.
        """
        with self._lock:
            size = os.fstat(self._file).st_size
            if size < self._end:
                raise BadInput(f"{self._name} was cut while it was read, after step {self.steps}")
            while not self.finished and size - self._end >= MARK.size and self._next(size):
                pass
            return self.steps

    def read(self) -> Trace:
        """The steps that came since the last time, all at first; looks for them. There may be none."""
        with self._lock:
            first, self._given = self._given, self.poll()
            return self.part(first, self._given)

    def part(self, first: int = 0, last: int | None = None, stride: int = 1) -> Trace:
        """Steps ``first`` to ``last - 1`` of those that are known, or every so many-th of them; nothing is kept.

        Without arguments all. Raises BadInput for others.
        """
        with self._lock:
            last = self.steps if last is None else last
            if not 0 <= first <= last <= self.steps:
                raise BadInput(f"steps {first} to {last} are not in {self._name}: it has {self.steps}")
            steps = range(first, last, stride)
            arrays = {name: np.empty((len(steps), *shape), kind) for name, (shape, kind) in self._shapes.items()}
            if stride == 1:
                self._fill(arrays, first, last)
            for at, step in enumerate(steps if stride > 1 else ()):
                self._fill({name: array[at : at + 1] for name, array in arrays.items()}, step, step + 1)
            return self._trace(arrays)

    def close(self) -> None:
        """Closes the file; traces that were given stay. May be called again."""
        with self._lock:
            if self._file >= 0:
                os.close(self._file)
                self._file = -1

    def _read_header(self) -> None:
        mark, length, checksum = MARK.unpack(self._bytes_at(0, MARK.size).ljust(MARK.size, b"\0"))
        if mark != HEADER:
            raise BadInput(f"{self._name} is not a live run of Beliefscope")
        content = self._bytes_at(MARK.size, length) if length <= LARGEST_HEADER else b""
        if _checksum(mark, length, content) != checksum:
            raise BadInput(f"{self._name} has no whole header")
        try:
            _, end = json.JSONDecoder().raw_decode(content.decode("latin-1"))
            header = read_json(content[:end])
            if header["format"] != FORMAT:
                raise BadInput(f"{self._name} is a live run of format {header['format']}; this version reads {FORMAT}")
            self._shapes, static = _shapes(header["arrays"]), _shapes(header["static"])
            self._row = _bytes(self._shapes)
            if self._row > LARGEST_STEP or _bytes(static) != length - end:
                raise ValueError(f"{self._row} bytes a step")
            self._static = {name: array.copy() for name, array in _split(content[end:], static, None).items()}
            self._said = header["trace"]
            self.expected, self.started, self.pid = header["expected"], str(header["started"]), int(header["pid"])
            if self.expected is not None and (type(self.expected) is not int or self.expected < 0):
                raise ValueError(f"it expects {self.expected!r} steps")
            self._trace({name: np.empty((0, *shape), kind) for name, (shape, kind) in self._shapes.items()})
        except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
            raise BadInput(f"{self._name} has a header that makes no sense: {error}") from None
        self.bytes_per_step = self._row
        self._end = MARK.size + length

    def _next(self, size: int) -> bool:
        """Takes the next block, if it is whole."""
        mark, rows, checksum = MARK.unpack(self._bytes_at(self._end, MARK.size))
        length = rows * self._row if mark == STEPS else 0
        end = self._end + MARK.size + length
        damaged = mark not in (STEPS, END) or length > max(LARGEST_BLOCK, self._row)
        if not damaged and end > size:
            return False  # under way, or cut off by the writer's end
        if damaged or _checksum(mark, rows, self._bytes_at(self._end + MARK.size, length)) != checksum:
            if not damaged and end == size:
                return False
            raise BadInput(f"{self._name} is damaged after step {self.steps}")
        if mark == END:
            self.finished = True
        else:
            self._firsts.append(self.steps)
            self._places.append(self._end + MARK.size)
            self.steps += rows
        self._end = end
        return True

    def _fill(self, arrays: Arrays, first: int, last: int) -> None:
        """Steps ``first`` to ``last - 1`` into arrays that have room for just these."""
        number = bisect_right(self._firsts, first) - 1
        at = first
        while at < last:
            start, place = self._firsts[number], self._places[number]
            stop = self._firsts[number + 1] if number + 1 < len(self._firsts) else self.steps
            rows = _split(self._bytes_at(place, (stop - start) * self._row), self._shapes, stop - start)
            to = min(stop, last)
            for name, array in arrays.items():
                array[at - first : to - first] = rows[name][at - start : to - start]
            at, number = to, number + 1

    def _trace(self, arrays: Arrays) -> Trace:
        return trace_of(self._said, arrays | self._static)

    def _bytes_at(self, place: int, length: int) -> bytes:
        parts = []
        while length and (part := os.pread(self._file, length, place)):
            parts.append(part)
            place, length = place + len(part), length - len(part)
        return b"".join(parts)


def load_live(path: Path) -> Trace:
    """The steps that are there. Raises BadInput as ``GrowingReader``, where the file is damaged, and without a step."""
    reader = GrowingReader(path)
    try:
        if not reader.poll():
            raise BadInput(f"{str(path)!r} has no step yet")
        return reader.part()
    finally:
        reader.close()


def _checksum(mark: bytes, number: int, content: bytes) -> int:
    return crc32(content, crc32(struct.pack("<4sI", mark, number)))


def _shapes_of_step(arrays: Mapping[str, NDArray[Any]]) -> Shapes:
    return {name: (array.shape[1:], array.dtype) for name, array in arrays.items()}


def _told(one: tuple[tuple[int, ...], np.dtype[Any]] | None) -> str:
    return "nothing" if one is None else f"{one[1]} {one[0]}"


def _described(shapes: Shapes) -> dict[str, Any]:
    return {name: [list(shape), kind.str] for name, (shape, kind) in shapes.items()}


def _shapes(described: Mapping[str, Any]) -> Shapes:
    """What ``_described`` was made of. Raises ValueError or TypeError for what no array can be."""
    found: Shapes = {}
    for name, (shape, kind) in described.items():
        numeric = re.fullmatch(r"[<>|][biuf]\d{1,2}", kind)
        if not numeric or not all(type(size) is int and size >= 0 for size in shape):
            raise ValueError(f"{name[:100]!r} of type {kind[:100]!r} and shape {str(shape)[:100]}")
        found[name] = tuple(shape), np.dtype(kind)
    return found


def _bytes(shapes: Shapes) -> int:
    return sum(math.prod(shape) * kind.itemsize for shape, kind in shapes.values())


def _split(content: bytes, shapes: Shapes, rows: int | None) -> Arrays:
    """The arrays that lie one behind the other; of so many steps, or not over steps."""
    arrays, at = {}, 0
    for name, (shape, kind) in shapes.items():
        full = shape if rows is None else (rows, *shape)
        arrays[name] = np.frombuffer(content, kind, math.prod(full), at).reshape(full)
        at += arrays[name].nbytes
    return arrays
