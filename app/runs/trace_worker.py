"""Worker process that runs filters and writes their traces."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.worker import WorkerDied, WorkerProcess
from beliefscope.datasets.catalog import stored_task
from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.strict_json import read_json
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint
from beliefscope.filters.external.load import load_external
from beliefscope.inspect.stored_runs import Progress, StoredRuns
from beliefscope.inspect.trace import save_trace
from beliefscope.inspect.traces.live_file import SUFFIX, LiveFileReader


@dataclass(frozen=True, kw_only=True)
class RunRequest(Selection):
    """A filter run in terms of files, so that another process can carry it out.

    Attributes:
        definition: of the task, as JSON text.
        checkpoint: checkpoint file, or the source of an external filter. external: whether it is the latter.
        path: file or folder of episodes, or the file of a live run.
        original: trace file of the run without intervention.
        output: trace file of the run.
    """

    definition: str
    checkpoint: str
    external: bool
    path: str
    original: str
    output: str
    seed: int
    particles: int

    def settings(self) -> dict[str, Any]:
        """Arguments of ``StoredRuns.run``."""
        return {
            "path": Path(self.original),
            "intervention": self.intervention,
            "only": self.only,
            "episode_index": self.episode,
            "seed": self.seed,
            "particles": self.particles,
            "faults": self.faults,
        }


class TraceWorker:
    """The worker process, reused between runs because starting it takes seconds. A dead one is replaced.

    Call ``run`` from one thread at a time; ``close`` may be called from any thread.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._closed = False
        self._process: WorkerProcess | None = None

    @property
    def started(self) -> bool:
        """Whether the process has been started."""
        return self._process is not None

    def start(self) -> WorkerProcess:
        """Start the process, unless it is running. Does not wait until it is ready."""
        with self._lock:
            if self._closed:
                raise RuntimeError("the server is stopping")
            if self._process is None or self._process.poll() is not None:
                self._process = WorkerProcess(__name__)
            return self._process

    def run(self, request: RunRequest, progress: Progress) -> None:
        """Run a filter and write its trace to ``request.output``. Raises as ``WorkerProcess.call``."""
        try:
            self.start().call("run_filter", request.to_json(), lambda fraction, _: progress(fraction))
        except WorkerDied as error:
            raise RuntimeError(f"the filter could not be run: {error}") from None

    def close(self) -> None:
        """End the process, also during a run."""
        with self._lock:
            self._closed = True
            if self._process is not None:
                self._process.kill()
                self._process.wait()


@lru_cache(maxsize=8)
def _checkpoint(source: str, external: bool, task: str) -> Checkpoint:
    definition = stored_task(read_json(task))
    return load_external(source, definition) if external else load_checkpoint(Path(source), (definition,))


@lru_cache(maxsize=8)
def _dataset(path: str, task: str) -> Dataset:
    return open_dataset(path, stored_task(read_json(task)))


def _episode(request: RunRequest) -> Episode:
    if request.path.endswith(SUFFIX):
        with closing(LiveFileReader(Path(request.path))) as reader:
            with suppress(BadInput):  # of a damaged file, the steps before the damage are used
                reader.poll()
            return reader.part().episode
    return _dataset(request.path, request.definition)[request.episode]


_runs = StoredRuns()


def run_filter(arguments: Mapping[str, Any], report: Callable[[float], None]) -> None:
    """Carry out a ``RunRequest`` in the worker process."""
    request = RunRequest.from_json(arguments)
    checkpoint = _checkpoint(request.checkpoint, request.external, request.definition)
    trace = _runs.run(checkpoint, _episode(request), progress=report, **request.settings())
    if request.output != request.original:
        save_trace(trace, Path(request.output))
