"""Traces from any file that contains one: a trace file, a recording or the file of a live run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from beliefscope.datasets.catalog import load_task
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.task import Task
from beliefscope.datasets.task_json import difference
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.names import RUNS
from beliefscope.inspect.trace import Trace, load_trace
from beliefscope.inspect.traces.live_file import SUFFIX, load_live
from beliefscope.inspect.traces.provenance import checkpoint_of
from beliefscope.recordings.log_readers.table_folder import numbered
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


def run_files(path: Path) -> list[Path]:
    """The recorded runs of a folder, in the order of ``numbered``; a file itself."""
    return sorted((f for f in path.iterdir() if f.suffix in RUNS), key=numbered) if path.is_dir() else [path]


def recorded_runs(path: Path) -> list[Trace]:
    """The runs of a file or folder, by their episodes; in the order of the files if these have the same index.

    Raises BadInput as ``open_trace``, and for runs of different filters or tasks.
    """
    return list(runs_by_file(path).values())


def runs_by_file(path: Path) -> dict[Path, Trace]:
    """As ``recorded_runs``, by their files."""
    files = run_files(path)
    traces = [open_trace(file) for file in files]
    checkpoint_of(traces, files)
    traces = with_distinct_indices(of_one_task(traces, [str(file) for file in files]))
    return dict(sorted(zip(files, traces, strict=True), key=lambda pair: pair[1].episode_index))


def with_distinct_indices(traces: Sequence[Trace]) -> list[Trace]:
    """The runs, numbered in their order if some have the same index of the episode."""
    if len({trace.episode_index for trace in traces}) < len(traces):
        return [replace(trace, episode_index=index) for index, trace in enumerate(traces)]
    return list(traces)


def of_one_task(traces: Sequence[Trace], places: Sequence[str]) -> list[Trace]:
    """The runs with the same definition of their task. Raises BadInput for runs of other tasks. places: for messages.

    An angle wraps in all of them if it does in one: a log shows this only if its values span more than half a turn.
    """
    wraps = [any(bools) for bools in zip(*([c.wraps for c in t.task.components] for t in traces), strict=False)]
    first = with_wraps(traces[0].task, wraps)
    for trace, place in zip(traces, places, strict=True):
        if other := difference(first, with_wraps(trace.task, wraps)):
            raise BadInput(f"{place} is of {other}, not of that of {places[0]}")
    return [replace(trace, episode=replace(trace.episode, task=first)) for trace in traces]


def with_wraps(task: Task, wraps: Iterable[bool]) -> Task:
    """The task with other marks of components that wrap around, in their order."""
    pairs = zip(task.components, wraps, strict=False)
    return replace(task, components=tuple(replace(component, wraps=wrap) for component, wrap in pairs))


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
