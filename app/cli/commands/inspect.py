"""``beliefscope inspect``"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from beliefscope.app.cli import output
from beliefscope.app.cli.options import Json, check, checkpoint, trace_in
from beliefscope.datasets.errors import BadInput, one_of

if TYPE_CHECKING:
    from beliefscope.filters.checkpoint import Checkpoint
    from beliefscope.inspect.trace import Trace


def inspect(
    paths: Annotated[list[Path], typer.Argument(metavar="TRACE...", help="Files of beliefscope trace, of one filter.")],
    filter_: Annotated[
        str,
        typer.Option(
            "--filter",
            metavar="NAME|CHECKPOINT",
            help="The filter that made them. Without it: of those that ship, the one with the traces' hash.",
        ),
    ] = "",
    only: Annotated[
        list[str] | None, typer.Option("--only", metavar="NAME", help="This diagnostic alone. May be repeated.")
    ] = None,
    options: Annotated[
        list[str] | None,
        typer.Option(
            "--option", metavar="NAME=VALUE", help="Of the diagnostics that have it: step=68. May be repeated."
        ),
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="The slow ones as well.")] = False,
    figures: Annotated[
        Path | None, typer.Option("--figures", metavar="DIR", help="Write a figure of each there; made if new.")
    ] = None,
    format_: Annotated[str, typer.Option("--format", metavar="NAME", help="Of the figures: svg, pdf or png.")] = "svg",
    json: Json = None,
) -> None:
    """Say what a trace tells about its filter.

    Every diagnostic that applies, with its verdict and its tables, and why the others do not. Several traces of one
    filter are independent trajectories, which give bounds and intervals. docs/diagnostics.md has what each one means.

    \b
    Examples:
      beliefscope inspect run.trace
      beliefscope inspect runs/*.trace --only consistency --figures figures --format pdf
      beliefscope inspect run.trace --only saliency --option step=68 --option target=beta:image
      beliefscope inspect run.trace --filter mine.safetensors --all --json -
    """
    from beliefscope.app.protocol.diagnostic_options import parse, says_how_far
    from beliefscope.datasets.catalog import find_task
    from beliefscope.inspect.catalog import DIAGNOSTICS
    from beliefscope.inspect.diagnostics.plotting import FORMATS, write_figure

    check(None, json)
    for name in only or ():
        if name not in DIAGNOSTICS:
            raise one_of("diagnostic", name, DIAGNOSTICS)
    chosen = {name: entry for name, entry in DIAGNOSTICS.items() if not only or name in only}
    given = pairs(options or (), {name for entry in chosen.values() for name in entry.options})
    parsed = {
        name: parse(entry, {option: given[option] for option in entry.options if option in given})
        for name, entry in chosen.items()
    }
    if format_ not in FORMATS:
        raise one_of("format of a figure", format_, FORMATS)
    if figures is not None and figures.exists() and not figures.is_dir():
        raise BadInput(f"--figures {str(figures)!r} is a file; give the name of a folder")
    traces = [trace_in(path) for path in paths]
    for path, trace in zip(paths, traces, strict=True):
        if trace.checkpoint_hash != traces[0].checkpoint_hash:
            raise BadInput(f"{path} is of another checkpoint than {paths[0]}: inspect the traces of one filter")
    made_by = checkpoint(find_task(traces[0].episode.task).name, filter_) if filter_ else shipped_by_hash(traces[0])
    if filter_ and made_by is not None and made_by.hash != traces[0].checkpoint_hash:
        raise BadInput(f"{paths[0]} was made by checkpoint {traces[0].checkpoint_hash[:12]}, not by {filter_!r}")
    if figures is not None:
        figures.mkdir(parents=True, exist_ok=True)

    found: dict[str, Any] = {}
    refused: dict[str, str] = {}
    text = []
    with output.progress("Inspecting") as advance:
        for done, (name, entry) in enumerate(chosen.items()):
            why = next(filter(None, (entry.refusal(trace, made_by) for trace in traces)), None)
            if why is None and entry.slow and not (every or only):
                why = f"takes a while: ask for it with --only {name} or --all"
            if why is not None:
                refused[name] = why
            else:
                share = lambda part, done=done: advance((done + part) / len(chosen))  # noqa: E731
                more = {"progress": share} if says_how_far(entry) else {}
                result = entry(traces, made_by, **parsed[name], **more)
                found[name] = result.to_dict()
                tables = [output.grid(one.title, one.columns, one.rows) for one in result.tables()]
                text.append("\n\n".join([f"{entry.title}: {result.verdict}", *tables]))
                if figures is not None:
                    write_figure(result.plot(), figures / f"{name}.{format_}")
            advance((done + 1) / len(chosen))
    if not found:
        raise BadInput("; ".join(refused.values()))
    text += [f"{DIAGNOSTICS[name].title}: not made. {why}" for name, why in refused.items()]
    document = {
        "task": traces[0].episode.task,
        "filter": traces[0].filter,
        "checkpoint_hash": traces[0].checkpoint_hash,
        "traces": [{"path": str(p), "episode": t.episode_index} for p, t in zip(paths, traces, strict=True)],
        "diagnostics": found,
        "not_made": refused,
    }
    output.result(document, "\n\n".join(text), json)


def pairs(texts: Iterable[str], known: Collection[str]) -> dict[str, str]:
    """Texts such as ``step=68`` by name. Raises BadInput for one of another form, and for a name that is not known."""
    values: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise BadInput(f"--option {text!r} has no value; write NAME=VALUE, such as step=68")
        if name not in known:
            raise one_of("option", name, sorted(known))
        values[name] = value
    return values


def shipped_by_hash(trace: Trace) -> Checkpoint | None:
    """The filter that made the trace, if it ships."""
    from beliefscope.filters.checkpoint import load_checkpoint, shipped

    try:
        found = load_checkpoint(shipped(trace.episode.task, trace.filter))
    except BadInput:
        return None
    return found if found.hash == trace.checkpoint_hash else None
