"""Jobs of recordings: writing one with likelihood maps, and opening the run of one."""

from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.trace_store import store_of_job
from beliefscope.app.runs.traced_run import TracedRun
from beliefscope.app.runs.worker import Report
from beliefscope.app.workspace.recordings import RecordingFolder
from beliefscope.inspect.catalog import quick
from beliefscope.inspect.maps.likelihood_map import MapOptions
from beliefscope.inspect.maps.map_engine import FINE, LikelihoodMap, Quantity
from beliefscope.inspect.traces.live_file import SUFFIX, write_live
from beliefscope.recordings.probe import RecordingInfo


def record(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Record a run with likelihood maps; a stored trace is reused."""
    path = Path(arguments["path"])
    with store_of_job(arguments) as store, closing(RecordingFolder(path.parent)) as files:
        report(0.0, "running the filter")
        run = store.request(Selection.from_json(arguments["selection"]))
        write(files, run, path, arguments["maps"], report, arguments["quantity"])
        return {"name": path.name}


def write(
    files: RecordingFolder,
    run: TracedRun,
    path: Path,
    stride: int = 0,
    report: Report = lambda share, message: None,
    quantity: Quantity = "likelihood",
) -> None:
    """Write a recording. stride: steps between maps of the quantity, 0 for none; steps without one are left out."""
    from beliefscope.recordings.rerun_log.metadata import describe  # imports Rerun, which takes a second
    from beliefscope.recordings.write import write_recording

    trace = run.trace
    steps = range(0, len(trace), stride) if stride else range(0)

    def maps() -> Iterator[LikelihoodMap]:
        for count, step in enumerate(steps, start=1):
            if run.no_maps_at(step) is None:
                yield run.map(step, FINE, MapOptions(quantity=quantity))
            report(count / len(steps), f"likelihood maps, {count} of {len(steps)}")

    with files.partial_file() as part:
        write_recording(trace, part, maps(), diagnostics=quick(trace, run.checkpoint))
        files.publish(part, path, RecordingInfo.from_json(describe(part), part))


def open_run(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Convert a recording to the file of a live run that has ended."""
    from beliefscope.recordings.read import read_recording  # imports Rerun

    report(0.0, "reading the recording")
    trace, path = read_recording(arguments["recording"]), Path(arguments["run"])
    report(0.5, "writing its steps")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_live(trace, path)
    return {"run": path.name.removesuffix(SUFFIX), "steps": len(trace)}
