"""Jobs of recordings: writing one with likelihood maps, and opening the run of one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from beliefscope.app.jobs.worker import Report
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.runs.traced_run import TracedRun
from beliefscope.app.workspace.recording_probe import RecordingInfo
from beliefscope.app.workspace.recordings import RecordingFolder
from beliefscope.inspect.catalog import quick
from beliefscope.inspect.likelihood import LikelihoodMap
from beliefscope.inspect.traces.live_file import SUFFIX, LiveFileWriter


def record(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Record a run with likelihood maps; a stored trace is reused."""
    store, files = TraceStore(Settings.from_json(arguments["settings"])), RecordingFolder(Path(arguments["folder"]))
    try:
        report(0.0, "running the filter")
        run = store.request(Selection.from_json(arguments["selection"]))
        path = write(files, run, arguments["name"], arguments["automatic"], arguments["maps"], report)
        return {"name": path.name}
    finally:
        files.close()
        store.close()


def write(
    files: RecordingFolder,
    run: TracedRun,
    name: str,
    automatic: bool,
    stride: int = 0,
    report: Report = lambda share, message: None,
) -> Path:
    """Write a new recording; its path. stride: steps between likelihood maps, 0 for none."""
    from beliefscope.recordings.rerun_log.metadata import describe  # imports Rerun, which takes a second
    from beliefscope.recordings.write import write_recording

    trace = run.trace
    steps = range(0, len(trace), stride) if stride else range(0)

    def maps() -> Iterator[LikelihoodMap]:
        for count, likelihood_map in enumerate(run.maps(steps), start=1):
            report(count / len(steps), f"likelihood maps, {count} of {len(steps)}")
            yield likelihood_map

    part = files.partial_path()
    try:
        write_recording(trace, part, maps(), diagnostics=quick(trace, run.checkpoint))
        return files.publish(part, RecordingInfo.from_json(describe(part), part), name, automatic)
    finally:
        part.unlink(missing_ok=True)


def open_run(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Convert a recording to the file of a live run that has ended."""
    from beliefscope.recordings.read import read_recording  # imports Rerun

    report(0.0, "reading the recording")
    trace, path = read_recording(arguments["recording"]), Path(arguments["run"])
    report(0.5, "writing its steps")
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    part.unlink(missing_ok=True)
    writer = LiveFileWriter(part, trace, len(trace))
    try:
        writer.append(trace)
        writer.finish()
        part.replace(path)
    finally:
        writer.close()
        part.unlink(missing_ok=True)
    return {"run": path.name.removesuffix(SUFFIX), "steps": len(trace)}
