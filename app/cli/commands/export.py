from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from beliefscope.app.cli import console, options as opt
from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.datasets.text import plural

if TYPE_CHECKING:
    from beliefscope.inspect.trace import Trace


def export(
    sources: list[Path] = opt.argument(
        "TRACE|RUN.rrd...", "Trace file or recording; several for a folder of interactive pages."
    ),
    output: Path = opt.option(
        "FILE|DIR",
        "Output: .parquet, .mcap, .npz, .rrd for Rerun, or .html for an interactive page; or a folder.",
        ...,
        "-o",
        "--output",
    ),
    task: str = opt.TASK_OF_FILES,
    filter: str = opt.TRACE_FILTER,
    interactive: bool = opt.flag("Write interactive pages: the default for .html and for folders.", "--interactive"),
) -> console.Result:
    """Export traces as tables, recordings or interactive pages.

    Parquet has one row per step and one column per number, for pandas and similar tools. MCAP has one topic per array,
    and images and particles in Foxglove's schemas. npz has the arrays unchanged. Names: docs/recordings.md. A Rerun
    recording has the diagnostics, but no maps. HTML is one file that works offline, for a paper's supplement or a
    colleague: timeline, maps, scene from above, images, values and diagnosis under one cursor; run.html#step=42 opens a
    step. A folder has a page for each trace, and index.html.

    \b
    Examples:
      beliefscope export run.trace -o run.parquet
      beliefscope export run.rrd -o run.mcap
      beliefscope export run.trace -o run.html --interactive
      beliefscope export first.trace second.trace -o supplement
    """
    from beliefscope.recordings.export import FORMATS, export_format, export_trace
    from beliefscope.recordings.open_trace import open_trace

    if not output.suffix or output.is_dir():
        return _folder(sources, output, task, filter)
    opt.check_output(output)
    if len(sources) > 1:
        raise BadInput(f"{len(sources)} traces need a folder as output, not {str(output)!r}")
    if interactive and output.suffix != ".html":
        raise BadInput(f"--interactive writes a page: output {str(output)!r} must end in .html")
    if output.suffix == ".html" or output.suffix.lower() == ".rrd":
        return opt.trace_result(_page_or_recording(sources[0], output, task, filter), output)
    check_name("export format", output.suffix.removeprefix(".").lower(), (*FORMATS, "html", "rrd"))
    export_format(output)
    trace = open_trace(sources[0], task)
    export_trace(trace, output)
    return opt.trace_result(trace, output)


def _page_or_recording(source: Path, output: Path, task: str, filter_: str) -> Trace:
    """Write the interactive page, or the Rerun recording with its diagnostics, of a trace."""
    from beliefscope.inspect.catalog import quick
    from beliefscope.recordings.open_trace import open_traces

    (trace,), checkpoint = open_traces([source], filter_, task)
    if output.suffix == ".html":
        from beliefscope.recordings.interactive.export import write_interactive

        with console.progress(source.stem) as advance:
            write_interactive(trace, output, checkpoint, progress=advance)
    else:
        from beliefscope.recordings.write import write_recording  # imports Rerun

        with console.progress("Recording") as advance:
            write_recording(trace, output, diagnostics=quick(trace, checkpoint), progress=advance)
    return trace


def _folder(sources: list[Path], folder: Path, task: str, filter_: str) -> console.Result:
    """Write a page for each trace, and their index."""
    from beliefscope.recordings.interactive.export import write_index

    names = [f"{source.stem}.html" for source in sources]
    if len({*names, "index.html"}) <= len(names):
        raise BadInput("traces need different names, other than index, to be pages of one folder")
    opt.check_folder(folder, "output")
    folder.mkdir(exist_ok=True)
    pages = [folder / name for name in names]
    traces = [_page_or_recording(source, page, task, filter_) for source, page in zip(sources, pages, strict=True)]
    index = folder / "index.html"
    write_index(list(zip(pages, traces, strict=True)), index)
    return console.Result({"pages": names}, plural(len(names), "page"), index)
