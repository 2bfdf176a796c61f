"""``beliefscope report``"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beliefscope.app.cli import options as opt
from beliefscope.app.cli import output as console
from beliefscope.app.runs.command_lines import is_code, is_path, report_command, serve_command, trace_command
from beliefscope.datasets.errors import BadInput

if TYPE_CHECKING:
    from beliefscope.filters.checkpoint import Checkpoint
    from beliefscope.inspect.trace import Trace

URL = "http://127.0.0.1:8000"
"""Default address of ``beliefscope serve``."""


def report(
    paths: Annotated[
        list[Path], typer.Argument(metavar="TRACE...", help="Traces or recordings of one filter, or folders of traces.")
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FOLDER", help="Output folder; replaces an existing report.")
    ] = Path("report"),
    title: Annotated[str, typer.Option(metavar="TEXT", help="Title of the report.")] = "",
    events: Annotated[
        list[str] | None,
        typer.Option(
            "--event",
            metavar="[EPISODE:]STEP",
            help="Step to show in detail, with images, maps and values. Repeatable. Default: the 3 with largest error.",
        ),
    ] = None,
    filter_: opt.TraceFilter = "",
    data: opt.DataPath = None,
    every: Annotated[bool, typer.Option("--all", help="Include slow diagnostics.")] = False,
    url: Annotated[str, typer.Option(metavar="ADDRESS", help="Address of the dashboard, for permalinks.")] = URL,
    pdf: Annotated[bool, typer.Option("--pdf", help="Also print report.pdf; requires Chromium.")] = False,
    json: opt.Json = None,
) -> None:
    """Write a report of filter runs.

    Creates a folder with a self-contained page, report.html: accuracy, verdicts, events with the largest error,
    figures, tables and methods. Each figure is also saved as SVG and PDF, each table as CSV, all numbers as JSON. A
    manifest has the hash of every file and the commands that reproduce the report. Details: docs/report.md.

    \b
    Examples:
      beliefscope report run.trace
      beliefscope report runs/*.trace -o report --title "Doors, 40 % image blackout" --pdf
      beliefscope report run.trace --event 35 --event 68 --all
    """
    from beliefscope.recordings.report.compose import compose, write_report
    from beliefscope.recordings.report.folder import check_folder
    from beliefscope.recordings.report.pdf import browser, print_page

    check_folder(output)
    chromium = browser() if pdf else None
    if not url.startswith(("http://", "https://")):
        raise BadInput(f"--url {url!r} is not an address such as {URL}")
    files = [file for path in paths for file in (sorted(path.glob("*.trace")) if path.is_dir() else [path])]
    if not files:
        raise BadInput(f"folder {str(paths[0])!r} contains no .trace file")
    traces, checkpoint = opt.open_traces(files, filter_)
    steps = [_parse_event(text, traces) for text in events or ()]
    link, links_note = _permalinks(traces, checkpoint, filter_, data, url)
    commands = [trace_command(trace, file.name, filter_, data) for file, trace in zip(files, traces, strict=True)]
    source = [*(["--filter", filter_] if filter_ else []), *(["--data", str(data)] if data else [])]
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
            progress=lambda fraction: advance(0.6 * fraction),
        )
        printer = None if chromium is None else lambda page, target: print_page(chromium, page, target)
        document = write_report(content, output, printer, lambda fraction: advance(0.6 + 0.4 * fraction))
    lines = [f"{content.titles[name][0]}: {verdict}" for name, verdict in document["diagnostics"].items()]
    lines += [f"{title}: not available: {reason}" for title, reason in document["not_made"].items()]
    size = sum(path.stat().st_size for path in output.rglob("*") if path.is_file())
    lines.append(f"{output / 'report.html'} ({len(document['files'])} files, {size / 1e6:.1f} MB)")
    console.result(document | {"path": str(output)}, "\n\n".join(lines), json)


def _parse_event(text: str, traces: Sequence[Trace]) -> tuple[int, int]:
    """Index of the trace and step of a text such as 68 or 9:68."""
    episode, _, step = text.rpartition(":")
    if not step.isdecimal() or (episode and not episode.isdecimal()):
        raise BadInput(f"--event {text!r} is not STEP or EPISODE:STEP, such as 68 or 9:68")
    episodes = [trace.episode_index for trace in traces]
    if not episode and len(traces) > 1:
        raise BadInput(f"--event {text!r} is ambiguous for {len(traces)} traces: write {episodes[0]}:{step}")
    if episode and int(episode) not in episodes:
        raise BadInput(f"--event {text!r}: no trace of episode {episode}. Available: {', '.join(map(str, episodes))}.")
    index = episodes.index(int(episode)) if episode else 0
    if int(step) >= len(traces[index]):
        raise BadInput(f"--event {text!r}: episode {episodes[index]} has steps 0 to {len(traces[index]) - 1}")
    return index, int(step)


def _permalinks(
    traces: Sequence[Trace], checkpoint: Checkpoint | None, filter_: str, data: Path | None, url: str
) -> tuple[Callable[[int, int], str], str]:
    """(index of a trace, step) -> permalink or empty text; and a note on how to open permalinks, or why none exist."""
    from beliefscope.app.protocol.permalinks import permalink
    from beliefscope.app.runs.catalog import served_names
    from beliefscope.datasets.catalog import find_task

    first, task = traces[0], find_task(traces[0].episode.task)
    if checkpoint is None:
        return lambda index, step: "", "No permalinks: the filter's checkpoint is not available."
    linked = _reproducible(traces, data)
    if not linked:
        source = "the sample episodes" if data is None else str(data)
        return lambda index, step: "", f"No permalinks: the dashboard cannot reproduce these runs over {source}."
    files = [filter_] if is_path(filter_) or is_code(filter_) else []
    names, data_name = served_names(files, data)
    name = names.get(str(Path(filter_)), filter_ or first.filter)

    def link(index: int, step: int) -> str:
        trace = traces[index]
        query = permalink(task, name, data_name, trace.episode_index, step, str(trace.faults))
        return f"{url.rstrip('/')}/{query}" if index in linked else ""

    return link, f"Permalinks open an event in the dashboard, served by: {serve_command(files, data, first.seed)}."


def _reproducible(traces: Sequence[Trace], data: Path | None) -> set[int]:
    """Indices of the traces that the dashboard reproduces: same episode and seed, 300 particles, no interventions."""
    from beliefscope.datasets.catalog import find_task
    from beliefscope.datasets.store import open_dataset, sample_path

    task = find_task(traces[0].episode.task)
    try:
        with open_dataset(sample_path(task.name) if data is None else data, task) as episodes:
            return {
                i
                for i, trace in enumerate(traces)
                if trace.episode_index < len(episodes)
                and episodes[trace.episode_index].digest() == trace.data_hash
                and trace.seed == traces[0].seed
                and trace.settings.get("particles", 300) == 300
                and not trace.settings.get("edits")
            }
    except BadInput:
        return set()
