"""Rerun streams to files, whose write errors are raised, and layouts sent to a stream."""

from __future__ import annotations

import os
from pathlib import Path
from threading import Thread
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from beliefscope.recordings.schema import APPLICATION

BLOCK = 1 << 16  # bytes in a pipe


def escaped_path(path: str) -> str:
    """A path whose names have Rerun's escapes of special characters, such as spaces."""
    return "/".join(map(rr.escape_entity_path_part, path.split("/")))


class FileStream(rr.RecordingStream):
    """A Rerun stream that writes its file itself, at paths whose names it escapes.

    When Rerun cannot write, it logs an error and stops writing, and a flush at that moment waits forever. Here Rerun
    writes to a pipe, which is always read, and a thread copies it to the file. ``flush`` and ``disconnect`` raise the
    OSError of a failed write; ``disconnect`` returns when the file is complete.
    """

    def __init__(self, recording_id: str | None = None) -> None:
        super().__init__(APPLICATION, recording_id=recording_id)
        self._thread: Thread | None = None
        self._error: OSError | None = None

    def save(self, path: str | Path, *args: Any, **options: Any) -> None:
        if not os.path.exists("/dev/fd"):  # no path of a pipe, as on Windows
            super().save(path, *args, **options)
            return
        target = open(path, "wb", buffering=0)  # noqa: SIM115, closed by the thread
        reading, writing = os.pipe()
        self._thread = Thread(target=self._copy, args=(reading, target), daemon=True)
        self._thread.start()
        try:
            super().save(f"/dev/fd/{writing}", *args, **options)
        finally:
            os.close(writing)  # Rerun has its own descriptor

    def _copy(self, reading: int, target: Any) -> None:
        with open(reading, "rb", buffering=0) as source, target:
            block = memoryview(bytearray(BLOCK))
            while size := source.readinto(block):
                rest = block[:size]
                try:
                    while rest and not self._error:
                        rest = rest[target.write(rest) :]
                except OSError as error:
                    self._error = error  # and read on: Rerun must never wait

    def log(self, entity_path: Any, *args: Any, **options: Any) -> None:
        super().log(escaped_path(entity_path), *args, **options)

    def send_columns(self, entity_path: Any, *args: Any, **options: Any) -> None:
        super().send_columns(escaped_path(entity_path), *args, **options)

    def flush(self, *, timeout_sec: float = 1e38) -> None:
        super().flush(timeout_sec=timeout_sec)
        if self._error:
            raise self._error

    def disconnect(self) -> None:
        super().disconnect()
        if self._thread:
            self._thread.join()
        if self._error:
            raise self._error


def send_layout(stream: rr.RecordingStream, layout: rrb.Blueprint) -> None:
    """Send a layout, which is active at once, also in a viewer that shows another recording.

    Send steps before: the viewer warns of a layout with a timeline that it has not received yet. Closes the stream that
    Rerun creates for a layout; otherwise its memory and two threads are never released.
    """
    opened, log = [], layout._log_to_stream

    def capture(own: rr.RecordingStream) -> None:
        opened.append(own)
        log(own)

    layout._log_to_stream = capture  # type: ignore[method-assign, assignment]
    try:
        stream.flush(timeout_sec=0.0)  # the steps first, without waiting for a viewer
        stream.send_blueprint(layout)
    finally:
        layout._log_to_stream = log  # type: ignore[method-assign]
        for own in opened:
            own.disconnect()
