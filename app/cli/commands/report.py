"""``beliefscope report``"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beliefscope.app.cli import output as console
from beliefscope.app.cli.commands.inspect import shipped_by_hash
from beliefscope.app.cli.options import DataPath, Json, check, checkpoint, is_code, is_path, serving, trace_in
from beliefscope.datasets.errors import BadInput

if TYPE_CHECKING:
    from beliefscope.filters.checkpoint import Checkpoint
    from beliefscope.inspect.trace import Trace

URL = "http://127.0.0.1:8000"
"""Where the page is, unless ``serve`` is told otherwise."""


def report(
    paths: Annotated[
        list[Path],
        typer.Argument(metavar="TRACE...", help="Traces or recordings of one filter, or folders of traces."),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="FOLDER", help="An older report there is replaced.")
    ] = Path("report"),
    heading: Annotated[str, typer.Option("--title", metavar="TEXT", help="Of the report.")] = "",
    moments: Annotated[
        list[str] | None,
        typer.Option(
            "--moment",
            metavar="[EPISODE:]STEP",
            help="Shown with pictures, maps and numbers, in place of the 3 worst. May be repeated.",
        ),
    ] = None,
    filter_: Annotated[
        str,
        typer.Option(
            "--filter",
            metavar="NAME|CHECKPOINT",
            help="The filter that made them. Without it: of those that ship, the one with the traces' hash.",
        ),
    ] = "",
    data: DataPath = None,
    every: Annotated[bool, typer.Option("--all", help="The diagnostics that take a while as well.")] = False,
    url: Annotated[str, typer.Option("--url", metavar="ADDRESS", help="Of the page that links open.")] = URL,
    pdf: Annotated[bool, typer.Option("--pdf", help="Print it as report.pdf too, with Chromium.")] = False,
    json: Json = None,
) -> None:
    """Write a report of a filter's runs.

    A folder with one page that needs nothing else and opens offline, report.html: accuracy, verdicts, the worst
    moments, figures, tables, methods; each figure as SVG and PDF, each table as CSV, the numbers as JSON, and a
    manifest with hashes of all of it and the commands that make it again. docs/report.md says what is in it.

    \b
    Examples:
      beliefscope report run.trace
      beliefscope report runs/*.trace -o report --title "Doors, 40 % black pictures" --pdf
      beliefscope report run.trace --moment 35 --moment 68 --all
    """
    from beliefscope.datasets.catalog import find_task
    from beliefscope.recordings.report.compose import compose, write_report
    from beliefscope.recordings.report.folder import check_folder
    from beliefscope.recordings.report.pdf import browser, print_page

    check(None, json)
    check_folder(output)
    chromium = browser() if pdf else None
    if not url.startswith(("http://", "https://")):
        raise BadInput(f"--url {url!r} is not an address such as {URL}")
    files = [file for path in paths for file in (sorted(path.glob("*.trace")) if path.is_dir() else [path])]
    if not files:
        raise BadInput(f"folder {str(paths[0])!r} holds no .trace file")
    traces = [trace_in(file) for file in files]
    first = traces[0]
    for file, trace in zip(files, traces, strict=True):
        if trace.checkpoint_hash != first.checkpoint_hash:
            raise BadInput(f"{file} is of another checkpoint than {files[0]}: a report is of one filter")
    task = find_task(first.episode.task)
    made_by = checkpoint(task.name, filter_) if filter_ else shipped_by_hash(first)
    if filter_ and made_by is not None and made_by.hash != first.checkpoint_hash:
        raise BadInput(f"{files[0]} was made by checkpoint {first.checkpoint_hash[:12]}, not by {filter_!r}")
    chosen = [_moment(text, traces) for text in moments or ()]
    link, opened = _links(traces, made_by, filter_, data, url)
    commands = [*(trace_command(trace, file.name, filter_, data) for file, trace in zip(files, traces, strict=True))]
    given = [*(["--filter", filter_] if filter_ else []), *(["--data", str(data)] if data else [])]
    commands.append(report_command([file.name for file in files], moments or (), every, heading, *given))
    with console.progress("Reporting") as advance:
        composed = compose(
            traces,
            made_by,
            files=files,
            title=heading,
            chosen=chosen,
            every=every,
            link=link,
            opened=opened,
            commands=tuple(commands),
            progress=lambda share: advance(0.6 * share),
        )
        printing = None if chromium is None else lambda page, printed: print_page(chromium, page, printed)
        document = write_report(composed, output, printing, lambda share: advance(0.6 + 0.4 * share))
    lines = [f"{composed.asked[name][0]}: {verdict}" for name, verdict in document["diagnostics"].items()]
    lines += [f"{title}: not made. {why}" for title, why in document["not_made"].items()]
    size = sum(path.stat().st_size for path in output.rglob("*") if path.is_file())
    lines.append(f"{output / 'report.html'} ({len(document['files'])} files, {size / 1e6:.1f} MB)")
    console.result(document | {"path": str(output)}, "\n\n".join(lines), json)


def _moment(text: str, traces: Sequence[Trace]) -> tuple[int, int]:
    """Index of the trace, and step, that a text such as 68 or 9:68 names."""
    episode, _, step = text.rpartition(":")
    if not step.isdecimal() or (episode and not episode.isdecimal()):
        raise BadInput(f"--moment {text!r} is not STEP or EPISODE:STEP, such as 68 or 9:68")
    known = [trace.episode_index for trace in traces]
    if not episode and len(traces) > 1:
        raise BadInput(f"--moment {text!r} could be of {len(traces)} traces: write {known[0]}:{step}, with its episode")
    if episode and int(episode) not in known:
        raise BadInput(f"--moment {text!r}: no trace is of episode {episode}. There are {', '.join(map(str, known))}.")
    index = known.index(int(episode)) if episode else 0
    if int(step) >= len(traces[index]):
        raise BadInput(f"--moment {text!r}: episode {known[index]} has steps 0 to {len(traces[index]) - 1}")
    return index, int(step)


def _links(
    traces: Sequence[Trace], made_by: Checkpoint | None, filter_: str, data: Path | None, url: str
) -> tuple[Callable[[int, int], str], str]:
    """(index of a trace, step) -> link, empty where there is none; and how links are opened, or why there are none."""
    from beliefscope.app.protocol.permalinks import moment_link
    from beliefscope.app.runs.catalog import served_names
    from beliefscope.datasets.catalog import find_task
    from beliefscope.datasets.store import open_dataset, sample_path

    first, task = traces[0], find_task(traces[0].episode.task)
    if made_by is None:
        return lambda index, step: "", "No links reopen them: the filter's checkpoint is not at hand."
    try:
        with open_dataset(sample_path(task.name) if data is None else data, task) as episodes:
            known = {
                i
                for i, trace in enumerate(traces)
                if trace.episode_index < len(episodes)
                and episodes[trace.episode_index].digest() == trace.data_hash
                and trace.seed == first.seed
                and trace.settings.get("particles", 300) == 300
                and not trace.settings.get("edits")
            }
    except BadInput:
        known = set()
    if not known:
        which = "the episodes that ship" if data is None else str(data)
        return lambda index, step: "", f"No links reopen them: they are not the dashboard's own runs over {which}."
    files = [filter_] if is_path(filter_) or is_code(filter_) else []
    named, data_name = served_names(files, data)
    filter_name = named.get(str(Path(filter_)), filter_ or first.filter)
    base = url.rstrip("/") + "/"

    def link(index: int, step: int) -> str:
        trace = traces[index]
        asked = moment_link(task, filter_name, data_name, trace.episode_index, step, str(trace.faults))
        return base + asked if index in known else ""

    served = serving(files, data, first.seed)
    return link, f"A link opens its moment in the dashboard while this runs: {served}."


def report_command(files: Sequence[str], moments: Sequence[object], every: bool, title: str, *more: str) -> str:
    """What makes the report of its traces again."""
    given = [*(f"--moment={moment}" for moment in moments), *(["--all"] if every else [])]
    given += ["--title", title] if title else []
    return shlex.join(["beliefscope", "report", *files, *given, *more, "-o", "report"])


def trace_command(trace: Trace, file: str, filter_: str, data: Path | None) -> str:
    """What makes the trace again. filter_: as named on a command line; the trace's own name where it is empty."""
    if trace.settings.get("edits"):
        return f"# {file} was edited by hand: its settings are in manifest.json"
    given = ["--data", str(data)] if data else []
    given += ["--faults", str(trace.faults)] if trace.faults else []
    particles = trace.settings.get("particles", 300)
    given += ["--particles", str(particles)] if particles != 300 else []
    words = ["beliefscope", "trace", trace.episode.task, "--filter", filter_ or trace.filter]
    words += ["--episode", str(trace.episode_index), *given, "--seed", str(trace.seed), "-o", file]
    return shlex.join(words)
