"""The views of a live run: its ``.live`` file followed and drawn into an ``.rrd``, while it grows and as a whole."""

from __future__ import annotations

import threading
import time
import warnings
from pathlib import Path

import rerun as rr

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.errors import BadInput
from beliefscope.inspect.traces.live_file import GrowingReader
from beliefscope.recordings.rerun_log.blueprint import blueprint
from beliefscope.recordings.rerun_log.bodies import Bodies
from beliefscope.recordings.schema import APPLICATION
from beliefscope.recordings.write import (
    STEPS_PER_CHUNK,
    chunks,
    let_go,
    new_recording,
    send_header,
    send_steps,
    thinning,
)

DRAWN_AT_ONCE = 10
LOOKS, PATIENCE = 0.1, 1.0
"""s between two looks at what is new; and after which fewer than DRAWN_AT_ONCE steps are drawn."""


class LiveViews:
    """Draws a live run's steps as they come, in a thread of its own; of the run it knows the file alone.

    Attributes:
        behind: the most steps by which it was ever behind the file.
    """

    def __init__(self, live: Path) -> None:
        """The ``.rrd`` is written beside the ``.live`` file, which need not be there yet."""
        self.behind = 0
        self._live = live
        self._ended, self._draw_rest = threading.Event(), False
        self._thread = threading.Thread(target=self._draw, name="live-views", daemon=True)

    def start(self) -> None:
        """Once the ``.live`` file is there."""
        self._thread.start()

    def close(self, draw_rest: bool) -> None:
        """Ends once the file does not grow any more: at once, or when all of its steps are drawn."""
        self._draw_rest = draw_rest
        self._ended.set()
        self._thread.join()

    def _draw(self) -> None:
        """Follows the file, in larger blocks the further it is behind."""
        rr.set_strict_mode(True)
        stream = rr.RecordingStream(APPLICATION)
        reader = GrowingReader(self._live)
        try:
            drawn, ended, at = 0, False, 0.0
            while not (ended and drawn == reader.steps):
                ended = self._ended.wait(0.0 if reader.steps > drawn + DRAWN_AT_ONCE else LOOKS)
                waiting = reader.poll() - drawn
                self.behind = max(self.behind, waiting)
                if drawn == 0 and waiting:
                    first = reader.part(0, 1)
                    task = find_task(first.episode.task)
                    layout, bodies = blueprint(first, task, growing=True), Bodies(first, task)
                    with let_go(layout):
                        # Without the index of every block, which would fill the memory of a long run.
                        stream.save(self._live.with_suffix(".rrd"), default_blueprint=layout, write_footer=False)
                    send_header(stream, first, bodies)
                if ended and not self._draw_rest:
                    return
                if waiting >= DRAWN_AT_ONCE or (waiting and (ended or time.monotonic() > at + PATIENCE)):
                    last = min(reader.steps, drawn + STEPS_PER_CHUNK)
                    send_part(stream, reader, bodies, drawn, last)
                    stream.flush()
                    drawn, at = last, time.monotonic()
        except (BadInput, RuntimeError, ValueError) as error:
            warnings.warn(f"the views of live run {str(self._live)!r} end: {error}", stacklevel=2)
        finally:
            stream.disconnect()
            reader.close()


def write_live(live: Path, path: Path) -> Path:
    """A live run's file -> the recording that ``write_recording`` makes of its trace, in memory that does not grow.

    Raises BadInput as ``GrowingReader`` and ``write_recording`` do, and for a run without a step.
    """
    reader = GrowingReader(live)
    try:
        if not reader.poll():
            raise BadInput(f"{str(live)!r} has no step yet")
        sample = reader.part(0, stride=thinning(reader.steps))
        task = find_task(sample.episode.task)
        bodies = Bodies(sample, task)
        with new_recording(path, sample, bodies, reader.steps, blueprint(sample, task)) as stream:
            for first, last in chunks(reader.steps):
                send_part(stream, reader, bodies, first, last)
                stream.flush()  # or all of it would wait in memory for the disk
    finally:
        reader.close()
    return path


def send_part(stream: rr.RecordingStream, reader: GrowingReader, bodies: Bodies, first: int, last: int) -> None:
    """Steps ``first`` to ``last - 1`` of a live run, stored and drawn."""
    before = max(0, first - 1)
    part = reader.part(before, last)
    send_steps(stream, part, find_task(part.episode.task), bodies, slice(first - before, last - before), before)
