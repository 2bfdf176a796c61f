"""A run that is being written to a live file: its new steps, and whether its writer is alive."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Iterable
from pathlib import Path

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task
from beliefscope.inspect.traces.live_file import SUFFIX, LiveFileReader

LIVENESS_INTERVAL = 0.25  # s between checks of a writer that adds no steps


class LiveRun:
    """A live file and the state of its writer. Methods may be called from any thread.

    Attributes:
        name: of the file, without its ending.
        template: the trace without its steps.
        task: of the run.
        reader: of the file.
        inode: distinguishes the file from a later one with the same name.
    """

    def __init__(self, path: Path, given: Iterable[Task] = ()) -> None:
        """Raises BadInput if the file is not a live run.

        Args:
            given: user-defined tasks, as for ``stored_task``.
        """
        self.name = path.name.removesuffix(SUFFIX)
        self.inode = path.stat().st_ino
        self.reader = LiveFileReader(path, given)
        try:
            self.template = self.reader.part(0, 0)
            self.task = self.template.task
        except BadInput:
            self.reader.close()
            raise
        self._damage = ""
        self._ended = False
        self._polled, self._polled_size = 0.0, -1
        self._lock = threading.Lock()

    def poll(self) -> int:
        """Read new steps; return their total number. A damaged file ends before the damage."""
        with self._lock:
            if not self._ended:
                self._polled, self._polled_size = time.monotonic(), self._file_size
                alive = self.reader.alive  # checked first, so that the last steps of an ended run are read
                try:
                    self.reader.poll()
                except BadInput as error:
                    self._damage = str(error)
                self._ended = bool(self._damage) or not alive
            return self.reader.steps

    @property
    def may_have_grown(self) -> bool:
        """Whether ``poll`` may return news: the file has grown, or the writer's state was not checked recently."""
        return self._file_size != self._polled_size or time.monotonic() > self._polled + LIVENESS_INTERVAL

    @property
    def _file_size(self) -> int:
        try:
            return self.reader.path.stat().st_size
        except OSError:
            return -1

    @property
    def state(self) -> str:
        """At the last poll: ``running``, ``ended``, ``died`` (without an end marker) or ``damaged``."""
        if not self._ended:
            return "running"
        return "damaged" if self._damage else "ended" if self.reader.finished else "died"

    @property
    def message(self) -> str:
        """Explanation of the state, if it needs one."""
        if self.state == "died":
            where = f"at step {self.reader.steps - 1}" if self.reader.steps else "before its first step"
            return f"Live run {self.name!r} stopped {where}: its process has exited without closing the file."
        return f"Live run {self.name!r}: {self._damage}." if self._damage else ""

    @property
    def key(self) -> str:
        """Hash that identifies the steps read so far."""
        parts = (self.name, self.reader.started, self.reader.pid, self.reader.steps)
        return hashlib.sha256(repr(parts).encode()).hexdigest()

    def close(self) -> None:
        """Close the file."""
        self.reader.close()
