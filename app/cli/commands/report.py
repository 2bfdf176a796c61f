from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beliefscope.app.cli import console, options as opt
from beliefscope.app.cli.healthy_records import record_for_runs
from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.report.command_lines import report_command, serve_command, trace_command

if TYPE_CHECKING:
    from beliefscope.filters.checkpoint import Checkpoint
    from beliefscope.inspect.trace import Trace
    from beliefscope.recordings.report.sections import Report


def report(
    paths: list[Path] = opt.argument("TRACE...", "Traces or recordings of one filter, or folders of traces."),
    output: Path = opt.option(
        "FOLDER", "Output folder; replaces an existing report.", Path("report"), "-o", "--output"
    ),
    title: str = opt.option("TEXT", "Title of the report.", ""),
    events: list[str] | None = opt.option(
        "[EPISODE:]STEP",
        "Step to show in detail, with images, maps and values. Repeatable. Default: the 3 with the largest error.",
        None,
        "--event",
    ),
    filter: str = opt.TRACE_FILTER,
    task: str = opt.TASK_OF_FILES,
    data: Path | None = None,
    profile_from: Path | None = opt.option(
        "DATA|DIR",
        "Healthy record of the diagnosis: clean data, whose held-out episodes the filter runs over, or a folder of "
        "healthy runs. Default: the record of the filter.",
        None,
    ),
    quantity: opt.Quantity | None = None,
    every: bool = opt.flag("Include slow diagnostics.", "--all"),
    url: str = opt.option("ADDRESS", "Address of the dashboard, for permalinks.", opt.URL),
    pdf: bool = opt.flag("Also print report.pdf; requires Chromium.", "--pdf"),
) -> console.Result:
    """Write a report of filter runs.

    Creates a folder with a self-contained page, report.html: accuracy, verdicts, events with the largest error,
    figures, tables and methods. Each figure is also saved as SVG and PDF, each table as CSV, all numbers as JSON. A
    manifest has the hash of every file and the commands that reproduce the report. Details: docs/report.md.

    \b
    Examples:
      beliefscope report run.trace
      beliefscope report runs/*.trace -o report --title "Doors, 40 % image blackout" --pdf
      beliefscope report run.trace --event 35 --event 68 --all
      beliefscope report traces/today --profile-from traces/healthy
    """
    from beliefscope.inspect.maps.availability import no_maps
    from beliefscope.recordings.open_trace import open_traces
    from beliefscope.recordings.report.compose import compose, parse_event, write_report
    from beliefscope.recordings.report.folder import check_folder
    from beliefscope.recordings.report.pdf import browser

    check_folder(output)
    chromium = browser() if pdf else None
    opt.check_url(url)
    files = _files(paths)
    opened, checkpoint = open_traces(files, filter, task)
    pairs = sorted(zip(files, opened, strict=True), key=lambda pair: pair[1].episode_index)
    files, traces, profile = [file for file, _ in pairs], [trace for _, trace in pairs], None
    if profile_from is not None:
        traces, _, profile = record_for_runs(traces, [str(file) for file in files], filter, profile_from)
    if quantity and checkpoint is not None and (reason := no_maps(checkpoint, traces[0], quantity)):
        raise BadInput(reason)
    steps = [parse_event(text, traces) for text in events or ()]
    link, links_note = _permalinks(traces, checkpoint, filter, data, url)
    commands = [trace_command(trace, file.name, filter, data) for file, trace in zip(files, traces, strict=True)]
    named = {"--map": quantity, "--filter": filter, "--data": data, "--profile-from": profile_from}
    source = [word for name, value in named.items() if value for word in (name, str(value))]
    commands.append(report_command([file.name for file in files], events or (), every, title, *source))
    with console.progress("Reporting") as advance:
        content = compose(
            traces,
            checkpoint,
            files=files,
            title=title,
            steps=steps,
            slow=every,
            link=link,
            links_note=links_note,
            commands=tuple(commands),
            quantity=quantity,
            profile=profile,
            progress=lambda fraction: advance(0.6 * fraction),
        )
        document = write_report(content, output, chromium, lambda fraction: advance(0.6 + 0.4 * fraction))
    return _result(document, content, output)


def _files(paths: Sequence[Path]) -> list[Path]:
    """The traces, and those in folders. Raises BadInput if there are none."""
    files = [file for path in paths for file in (sorted(path.glob("*.trace")) if path.is_dir() else [path])]
    if not files:
        raise BadInput(f"folder {str(paths[0])!r} contains no .trace file")
    return files


def _result(document: dict[str, Any], content: Report, output: Path) -> console.Result:
    """Diagnosis, verdicts and missing parts of a report, and the size of its folder. document: its manifest."""
    from beliefscope.inspect.catalog import reason_text

    lines = [f"Diagnosis: {headline}"] if (headline := document["diagnosis"]) else []
    lines += [f"{content.titles[name][0]}: {verdict}" for name, verdict in document["diagnostics"].items()]
    lines += [f"{title}: {reason_text(reason)}" for title, reason in document["not_made"].items()]
    size = sum(path.stat().st_size for path in output.rglob("*") if path.is_file())
    lines.append(f"{output / 'report.html'} ({len(document['files'])} files, {size / 1e6:.1f} MB)")
    return console.Result(document | {"path": str(output)}, "\n\n".join(lines))


def _permalinks(
    traces: Sequence[Trace], checkpoint: Checkpoint | None, filter_: str, data: Path | None, url: str
) -> tuple[Callable[[int, int], str], str]:
    """(index of a trace, step) -> permalink or empty text; and a note on how to open permalinks, or why none exist."""
    from beliefscope.app.protocol.permalinks import permalink
    from beliefscope.app.runs.catalog import served_names
    from beliefscope.filters.names import is_source
    from beliefscope.inspect.traces.provenance import reproducible

    first, task = traces[0], traces[0].task
    if checkpoint is None:
        return lambda index, step: "", "No permalinks: the filter's checkpoint is not available."
    linked = reproducible(traces, data)
    if not linked:
        source = "the sample episodes" if data is None else str(data)
        return lambda index, step: "", f"No permalinks: the dashboard cannot reproduce these runs over {source}."
    files = [filter_] if is_source(filter_) else []
    (name,), data_name = served_names(files or [first.filter], data)

    def link(index: int, step: int) -> str:
        trace = traces[index]
        query = permalink(task, name, data_name, trace.episode_index, step, str(trace.faults))
        return f"{url.rstrip('/')}/{query}" if index in linked else ""

    return link, f"Permalinks open an event in the dashboard, served by: {serve_command(files, data, first.seed)}."
