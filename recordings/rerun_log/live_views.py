"""Recording of a live run: converts its ``.live`` file to an ``.rrd``, both while it grows and at the end."""

from __future__ import annotations

import threading
import time
import warnings
from pathlib import Path

import rerun as rr

from beliefscope.datasets.errors import BadInput
from beliefscope.inspect.traces.live_file import LiveFileReader
from beliefscope.recordings.rerun_log.blueprint import blueprint
from beliefscope.recordings.rerun_log.bodies import Bodies
from beliefscope.recordings.rerun_log.stream import FileStream, send_layout
from beliefscope.recordings.write import (
    chunks,
    new_recording,
    send_header,
    send_steps,
    steps_per_chunk,
    thinning,
)

MIN_STEPS = 10
POLL_INTERVAL, MAX_DELAY = 0.1, 1.0
"""s between two polls of the file, and after which fewer than MIN_STEPS new steps are written."""


class LiveViews:
    """Writes the steps of a live run to an ``.rrd`` as they arrive, in a separate thread that only reads the file.

    Attributes:
        behind: maximum number of steps by which it lagged behind the file.
    """

    def __init__(self, live: Path) -> None:
        """The ``.rrd`` is written next to the ``.live`` file, which may not exist yet."""
        self.behind = 0
        self._live = live
        self._ended, self._write_rest = threading.Event(), False
        self._thread = threading.Thread(target=self._follow, name="live-views", daemon=True)

    def start(self) -> None:
        """Start the thread, once the ``.live`` file exists."""
        self._thread.start()

    def close(self, write_rest: bool) -> None:
        """Stop, after the file is complete: at once, or after writing its remaining steps."""
        self._write_rest = write_rest
        self._ended.set()
        self._thread.join()

    def _follow(self) -> None:
        rr.set_strict_mode(True)
        stream, reader = FileStream(), LiveFileReader(self._live)
        try:
            try:
                self._write(stream, reader)
            finally:
                reader.close()
                stream.disconnect()
        except (BadInput, OSError, RuntimeError, ValueError) as error:
            warnings.warn(f"the recording of live run {str(self._live)!r} ends: {error}", stacklevel=2)

    def _write(self, stream: FileStream, reader: LiveFileReader) -> None:
        """Follow the file, in larger blocks the further behind."""
        written, ended, written_at, at_once = 0, False, 0.0, 1
        while not (ended and written == reader.steps):
            ended = self._ended.wait(0.0 if reader.steps > written + MIN_STEPS else POLL_INTERVAL)
            waiting = reader.poll() - written
            self.behind = max(self.behind, waiting)
            if written == 0 and waiting:
                first = reader.part(0, 1)
                task, at_once = first.task, steps_per_chunk(first)
                layout, bodies = blueprint(first, task, growing=True), Bodies(first, task)
                # Without footer: the index of all chunks would fill the memory of a long run.
                stream.save(self._live.with_suffix(".rrd"), write_footer=False)
                send_header(stream, first, bodies)
            if ended and not self._write_rest:
                return
            if waiting >= MIN_STEPS or (waiting and (ended or time.monotonic() > written_at + MAX_DELAY)):
                last = min(reader.steps, written + at_once)
                send_part(stream, reader, bodies, written, last)
                if written == 0:
                    send_layout(stream, layout)
                stream.flush()
                written, written_at = last, time.monotonic()


def write_live_recording(live: Path, path: Path) -> Path:
    """A live run's file -> the recording that ``write_recording`` makes of its trace, in memory that does not grow.

    Raises BadInput as ``LiveFileReader`` and ``write_recording`` do, and for a run without a step.
    """
    reader = LiveFileReader(live)
    try:
        if not reader.poll():
            raise BadInput(f"{str(live)!r} has no step yet")
        sample = reader.part(0, stride=thinning(reader.steps))
        task = sample.task
        bodies = Bodies(sample, task)
        layout = blueprint(sample, task)
        with new_recording(path, sample, bodies, reader.steps) as stream:
            for first, last in chunks(reader.steps, steps_per_chunk(sample)):
                send_part(stream, reader, bodies, first, last)
                if first == 0:
                    send_layout(stream, layout)
                stream.flush()  # or all of it would wait in memory for the disk
    finally:
        reader.close()
    return path


def send_part(stream: rr.RecordingStream, reader: LiveFileReader, bodies: Bodies, first: int, last: int) -> None:
    """Steps ``first`` to ``last - 1`` of a live run, stored and drawn."""
    before = max(0, first - 1)
    part = reader.part(before, last)
    send_steps(stream, part, part.task, bodies, slice(first - before, last - before), before)
