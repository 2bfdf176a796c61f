"""Traces from any file that contains one: a trace file, a recording or the file of a live run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from beliefscope.datasets.catalog import load_task
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task
from beliefscope.datasets.task_json import difference
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.trace import Trace, load_trace
from beliefscope.inspect.traces.live_file import SUFFIX, load_live
from beliefscope.inspect.traces.provenance import checkpoint_of
from beliefscope.recordings.probe import RecordingProbe


def open_trace(path: Path, task: str = "") -> Trace:
    """Read a trace. Raises BadInput if the file is damaged or the trace is not of the task.

    task: name or ``FILE.py:NAME``, with its functions; by default the definition in the file, without.
    """
    return _open(_read_recording if path.suffix in (".rrd", SUFFIX) else load_trace, path, task)


def open_recording(path: Path, task: str = "") -> Trace:
    """As ``open_trace``, only from a recording or a live file."""
    return _open(_read_recording, path, task)


def open_traces(paths: Sequence[Path], filter_: str, task: str = "") -> tuple[list[Trace], Checkpoint | None]:
    """Read traces of one filter, and its checkpoint if available; see ``open_trace`` and ``checkpoint_of``."""
    traces = [open_trace(path, task) for path in paths]
    return traces, checkpoint_of(traces, paths, filter_)


def _open(read: Callable[[Path, Sequence[Task]], Trace], path: Path, name: str) -> Trace:
    given = [load_task(name)] if name else []
    trace = read(path, given)
    for task in given:
        if other := difference(task, trace.task):
            raise BadInput(f"{path} is of {other}, not of task {task.name!r}")
    return trace


def _read_recording(path: Path, given: Sequence[Task]) -> Trace:
    """A separate process checks recordings first (Rerun may crash)."""
    from beliefscope.recordings.read import read_recording  # imports Rerun

    if path.suffix == SUFFIX:
        return load_live(path, given)
    if path.is_file():
        metadata = RecordingProbe()(path)
        if metadata.problem and not metadata.application:
            raise BadInput(f"{path}: {metadata.problem}")
    return read_recording(path, given)
