"""Worker process that runs filters, so that the server stays responsive and survives a crash.

    python -m beliefscope.app.runs.trace_worker

Standard input carries one request a line, JSON; standard output carries progress and the outcome of each.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, TextIO

from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.subprocesses import NICENESS, REPORT_INTERVAL, exit_description, redirect_stdout
from beliefscope.datasets.catalog import find_task, load_task
from beliefscope.datasets.dataset import Dataset
from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.checkpoint import Checkpoint, load_checkpoint
from beliefscope.filters.external.load import load_external
from beliefscope.inspect.stored_runs import Progress, StoredRuns
from beliefscope.inspect.trace import save_trace
from beliefscope.inspect.traces.live_file import SUFFIX, LiveFileReader


@dataclass(frozen=True)
class RunRequest:
    """A filter run in terms of files, so that another process can carry it out.

    Attributes:
        selection: the run.
        checkpoint: checkpoint file, or the source of an external filter.
        external_task: task of an external filter; empty for a checkpoint file.
        data: file or folder of episodes, or the file of a live run.
        original: trace file of the run without intervention.
        output: trace file of the run.
        seed, particles: settings of the filter.
        user_tasks: user-defined tasks to register first.
    """

    selection: Selection
    checkpoint: str
    external_task: str
    data: str
    original: str
    output: str
    seed: int
    particles: int
    user_tasks: tuple[str, ...] = ()

    def settings(self) -> dict[str, Any]:
        """Arguments of ``StoredRuns.run``."""
        selection = self.selection
        return {
            "path": Path(self.original),
            "edit": selection.edit,
            "only": selection.only,
            "episode_index": selection.episode,
            "seed": self.seed,
            "particles": self.particles,
            "faults": selection.faults,
        }

    def to_json(self) -> dict[str, Any]:
        """The request as JSON values."""
        return {**vars(self), "selection": self.selection.to_json()}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> RunRequest:
        """Inverse of ``to_json``."""
        return cls(**{**values, "selection": Selection.from_json(values["selection"])})


class TraceWorker:
    """The worker process, reused between runs because starting it takes seconds. A dead one is replaced.

    Call ``run`` from one thread at a time; ``close`` may be called from any thread.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._closed = False
        self._process: subprocess.Popen[str] | None = None

    @property
    def started(self) -> bool:
        """Whether the process has been started."""
        return self._process is not None

    def start(self) -> None:
        """Start the process, unless it is running. Does not wait until it is ready."""
        with self._lock:
            if self._closed:
                raise RuntimeError("the server is stopping")
            if self._process is None or self._process.poll() is not None:
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-m", __name__],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    text=True,
                    bufsize=1,
                    start_new_session=True,  # Ctrl+C in the terminal stops the server only
                )

    def run(self, request: RunRequest, progress: Progress) -> None:
        """Run a filter and write its trace to ``request.output``. An exception of ``progress`` kills the process.

        Raises:
            BadInput: the request does not fit the filter.
            RuntimeError: any other failure, such as the death of the process.
        """
        self.start()
        process = self._process
        assert process is not None
        assert process.stdin is not None
        assert process.stdout is not None
        outcome = None
        try:
            process.stdin.write(json.dumps(request.to_json()) + "\n")
            for line in process.stdout:
                message = json.loads(line)
                if "progress" not in message:
                    outcome = message
                    break
                progress(message["progress"])
        except OSError:
            pass  # the process has died
        except BaseException:
            process.kill()
            raise
        if outcome is None:
            raise RuntimeError(f"the filter could not be run: its process {exit_description(process.wait())}")
        if outcome["error"] is not None:
            raise (BadInput if outcome["bad_input"] else RuntimeError)(outcome["error"])

    def close(self) -> None:
        """End the process, also during a run."""
        with self._lock:
            self._closed = True
            if self._process is not None:
                self._process.kill()
                self._process.wait()


@lru_cache(maxsize=8)
def _checkpoint(source: str, external_task: str) -> Checkpoint:
    return load_external(source, external_task) if external_task else load_checkpoint(Path(source))


@lru_cache(maxsize=8)
def _dataset(path: str, task: str) -> Dataset:
    return open_dataset(path, find_task(task))


_load_user_task = cache(load_task)


def _episode(request: RunRequest) -> Episode:
    if request.data.endswith(SUFFIX):
        with closing(LiveFileReader(Path(request.data))) as reader:
            with suppress(BadInput):  # of a damaged file, the steps before the damage are used
                reader.poll()
            return reader.part().episode
    return _dataset(request.data, request.selection.task)[request.selection.episode]


def _execute(request: RunRequest, runs: StoredRuns, output: TextIO) -> None:
    last_report = time.monotonic()

    def progress(fraction: float) -> None:
        nonlocal last_report
        if time.monotonic() - last_report >= REPORT_INTERVAL:
            last_report = time.monotonic()
            output.write(json.dumps({"progress": fraction}) + "\n")

    for task in request.user_tasks:
        _load_user_task(task)
    checkpoint = _checkpoint(request.checkpoint, request.external_task)
    trace = runs.run(checkpoint, _episode(request), progress=progress, **request.settings())
    if request.output != request.original:
        save_trace(trace, Path(request.output))


def main() -> None:
    """Carry out requests until standard input ends."""
    os.nice(NICENESS)
    output, runs = redirect_stdout(), StoredRuns()
    for line in sys.stdin:
        outcome: dict[str, Any] = {"error": None, "bad_input": False}
        try:
            _execute(RunRequest.from_json(json.loads(line)), runs, output)
        except BadInput as error:
            outcome = {"error": str(error), "bad_input": True}
        except Exception as error:
            outcome["error"] = f"{type(error).__name__}: {error}"
        output.write(json.dumps(outcome) + "\n")
    os._exit(0)  # faster than the regular shutdown of PyTorch


if __name__ == "__main__":
    main()
