"""The live runs of a workspace (``inspect.growing``): filters that run now, or did, and wrote each step as it came.

A run is one episode of a data set named ``live:NAME``, wherever a data set is named. Its file is the queue between the
filter and whoever watches: nothing is kept for anyone, and the filter knows of nobody.
"""

from __future__ import annotations

import hashlib
import threading
import time
from collections import OrderedDict
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from beliefscope.app.protocol.messages import header
from beliefscope.app.runs.selection import Selection, Traced
from beliefscope.app.server.security import kept_file
from beliefscope.app.workspace.json_files import is_text
from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import WHOLE
from beliefscope.datasets.task import Task
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import Foreign
from beliefscope.inspect.likelihood import LikelihoodMap, MapEngine, no_maps
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.live_file import SUFFIX, GrowingReader

PREFIX = "live:"
LISTED = 30  # runs, the newest
SURE = 0.25  # s after which it is looked whether a filter that writes nothing lives
WHOLE_IN_MEMORY = 4  # runs that have ended


class Absent(Foreign):
    """A filter that is not here, known by the run it left: its Gaussians can be drawn, no network asked."""

    def __init__(self, trace: Trace, task: Task) -> None:
        values = {"name": trace.filter, "record": {}, "hash": trace.checkpoint_hash, "source": trace.filter}
        for key, value in (values | {"_task": task}).items():
            object.__setattr__(self, key, value)  # a checkpoint is frozen

    def run(self, *_: Any, **__: Any) -> Any:
        """Raises BadInput."""
        raise BadInput(f"filter {self.name!r} is known by its live run alone; serve it with --filter to run it again")


class Run:
    """One file. Methods may be called from any thread.

    Attributes:
        name: without ``live:``. like: a trace of none of its steps, which says all that is not over steps.
        task: of the run. reader: of the file. file: tells it from another one of the same name.
    """

    def __init__(self, path: Path) -> None:
        """Raises BadInput for what is no such file, and for a task that is not known here."""
        self.name = path.name.removesuffix(SUFFIX)
        self.file = path.stat().st_ino
        self.reader = GrowingReader(path)
        try:
            self.like = self.reader.part(0, 0)
            self.task = find_task(self.like.episode.task)
        except BadInput:
            self.reader.close()
            raise
        self.damage = ""
        self._ended = False
        self._looked, self._size = 0.0, -1
        self._newest: Growing | None = None
        self._lock = threading.Lock()

    def look(self) -> int:
        """Looks for new steps; how many there are. A damaged file has ended where the damage begins."""
        with self._lock:
            if not self._ended:
                self._looked, self._size = time.monotonic(), self._bytes
                alive = self.reader.alive  # before the last look: what it wrote until its end is to be found
                try:
                    self.reader.poll()
                except BadInput as error:
                    self.damage = str(error)
                self._ended = bool(self.damage) or not alive
            return self.reader.steps

    @property
    def stirs(self) -> bool:
        """Whether a look may find something: the file is longer than at the last one, or that is some time ago."""
        return self._bytes != self._size or time.monotonic() > self._looked + SURE

    @property
    def _bytes(self) -> int:
        try:
            return self.reader.path.stat().st_size
        except OSError:
            return -1

    @property
    def state(self) -> str:
        """``running``, ``ended``, ``died`` without an end, or ``damaged``; as of the last look."""
        if not self._ended:
            return "running"
        return "damaged" if self.damage else "ended" if self.reader.finished else "died"

    @property
    def told(self) -> str:
        """What is to be said of the state; mostly nothing."""
        if self.state == "died":
            where = f"at step {self.reader.steps - 1}" if self.reader.steps else "before its first step"
            return f"Live run {self.name!r} ended without closing {where}: its process is gone."
        return f"Live run {self.name!r}: {self.damage}." if self.damage else ""

    def growing(self, checkpoint: Checkpoint) -> Growing:
        """As much as there is by now."""
        with self._lock:
            if self._newest is None or len(self._newest) != self.reader.steps:
                self._newest = Growing(self, checkpoint)
            return self._newest

    def whole(self, checkpoint: Checkpoint) -> Traced:
        """The trace of a run that has ended."""
        self._newest = None
        found = Traced(_key(self), checkpoint)
        found.done.set_result(self.reader.part(0))
        return found

    def close(self) -> None:
        """Closes the file."""
        self.reader.close()


class Growing(Traced):
    """A run that goes on: the steps there are by now, read when they are asked for."""

    grows = True

    def __init__(self, run: Run, checkpoint: Checkpoint) -> None:
        super().__init__(_key(run), checkpoint)
        self._run, self._steps = run, run.reader.steps
        self._last = self._part(max(0, self._steps - 1), self._steps)
        self.shown = f"{run.name} {run.file}"

    def _part(self, first: int, last: int) -> Trace:
        return self._run.reader.part(first, last)

    @cached_property
    def _all(self) -> Trace:
        return self._part(0, self._steps)

    def ready(self, timeout: float) -> bool:
        """Whether there is a step."""
        return self._steps > 0

    def result(self, timeout: float | None = None) -> Trace:
        """All of it: for who wants more than the page shows of it by itself."""
        return self._all

    def __len__(self) -> int:
        return self._steps

    def at(self, step: int) -> tuple[Trace, int]:
        return self._part(step, step + 1), 0

    @cached_property
    def no_maps(self) -> str | None:
        return no_maps(self.checkpoint, self._last)

    def map(self, step: int, angle: float | None, size: int) -> LikelihoodMap:
        """Made of the step alone: the pictures of all that came before need not be encoded for it."""
        return replace(MapEngine(self.checkpoint, self.at(step)[0]).map(0, angle=angle, size=size), step=step)

    def header(self) -> dict[str, Any]:
        """What a page must know before the steps come. Each block of those describes its columns."""
        said = header(self._last, [], self._run.task, self.no_maps)
        return said | {"steps": self._steps, "live": described(self._run)}


class LiveRuns:
    """The runs of a folder, ``NAME.live`` each. Methods may be called from any thread."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._runs: dict[str, Run] = {}
        self._whole: OrderedDict[str, Traced] = OrderedDict()
        self._lock = threading.Lock()

    def __getitem__(self, name: str) -> Run:
        """As it is now. Raises BadInput for a name that is not there, and for what is no run that can be shown."""
        path = self.folder / f"{name}{SUFFIX}"
        if not name or "/" in name or kept_file(self.folder, path.name) is None:
            raise BadInput(f"live run {name!r} does not exist in {str(self.folder)!r}")
        with self._lock:
            known = self._runs.get(name)
            if known is None or known.file != path.stat().st_ino:
                if known is not None:
                    known.close()
                    del self._runs[name]
                known = self._runs[name] = Run(path)
        known.look()
        return known

    def newest(self) -> list[str]:
        """Names, the newest first. Runs whose files have gone are forgotten."""
        times: dict[str, float] = {}
        for path in self.folder.glob(f"*{SUFFIX}") if self.folder.is_dir() else ():
            with suppress(OSError):
                if is_text(path.name):
                    times[path.name.removesuffix(SUFFIX)] = path.stat().st_mtime
        with self._lock:
            for name in self._runs.keys() - times.keys():
                self._runs.pop(name).close()
        return sorted(times, key=lambda name: -times[name])[:LISTED]

    def traced(self, asked: Selection, filters: Mapping[str, Checkpoint]) -> Traced | None:
        """The run that a selection asks for; None where it asks what something else would make of the run's episode.

        Raises BadInput for a run that is not there, has no step yet, or goes on where its episode is asked for.
        """
        run = self[asked.data.removeprefix(PREFIX)]
        name, checkpoint = called(run, filters)
        if (asked.task, asked.episode) != (run.task.name, run.like.episode_index):
            raise BadInput(
                f"live run {run.name!r} is of task {run.task.name!r}, episode {run.like.episode_index}, "
                f"not of {asked.task!r}, episode {asked.episode}"
            )
        if (asked.filter, asked.faults, asked.edit) != (name, WHOLE, None):
            return None
        if run.state == "running":
            return run.growing(checkpoint)
        with self._lock:
            key = _key(run)
            if key not in self._whole:
                self._whole[key] = run.whole(checkpoint)
            self._whole.move_to_end(key)
            while len(self._whole) > WHOLE_IN_MEMORY:
                self._whole.popitem(last=False)
            return self._whole[key]

    def ended(self, data: str) -> Run:
        """The run of a data set's name. Raises BadInput while it goes on."""
        run = self[data.removeprefix(PREFIX)]
        if run.state == "running":
            raise BadInput(f"live run {run.name!r} goes on: all of its steps are needed, once it has ended")
        return run

    def episode(self, data: str) -> Episode:
        """What a run's filter was given. Raises BadInput while it goes on, and where no filter could start on it."""
        run = self.ended(data)
        episode = run.reader.part(0).episode
        if not len(episode) or np.isnan(episode.states[0]).any():
            raise BadInput(f"the true state of live run {run.name!r} is not known, from which a filter would start")
        return episode

    def close(self) -> None:
        """Closes the files."""
        with self._lock:
            for run in self._runs.values():
                run.close()
            self._runs.clear()


def called(run: Run, filters: Mapping[str, Checkpoint]) -> tuple[str, Checkpoint]:
    """The run's filter among those of its task, by its hash, and the name it is shown by; else what is known of it."""
    hash_ = run.like.checkpoint_hash
    name = name_of(run.like.filter, hash_, filters)
    there = filters.get(name)
    return name, there if there is not None and there.hash == hash_ else Absent(run.like, run.task)


def name_of(name: str, hash_: str, filters: Mapping[str, Checkpoint]) -> str:
    """What the filter of that name and hash is called beside those of its task, of which it may be one."""
    of_hash = [shown for shown, checkpoint in filters.items() if hash_ and checkpoint.hash == hash_]
    if of_hash:
        return name if name in of_hash else of_hash[0]
    return f"{name} (live)" if name in filters else name


def described(run: Run) -> dict[str, Any]:
    """A run in the page's list."""
    return {
        "name": run.name,
        "data": f"{PREFIX}{run.name}",
        "task": run.task.name,
        "episode": run.like.episode_index,
        "faults": str(run.like.faults),
        "steps": run.reader.steps,
        "expected": run.reader.expected,
        "started": run.reader.started,
        "state": run.state,
        "told": run.told,
    }


def _key(run: Run) -> str:
    known = (run.name, run.reader.started, run.reader.pid, run.reader.steps)
    return hashlib.sha256(repr(known).encode()).hexdigest()
