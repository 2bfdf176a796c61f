"""``beliefscope inspect``"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from beliefscope.app.cli import options as opt
from beliefscope.app.cli import output
from beliefscope.datasets.errors import BadInput, unknown_name

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from beliefscope.filters.checkpoint import Checkpoint
    from beliefscope.inspect.diagnostics.base import Diagnostic, Entry
    from beliefscope.inspect.trace import Trace


def inspect(
    paths: Annotated[list[Path], typer.Argument(metavar="TRACE...", help="Traces of one filter.")],
    filter_: opt.TraceFilter = "",
    only: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Run only this diagnostic. Repeatable.")
    ] = None,
    options: Annotated[
        list[str] | None,
        typer.Option("--option", metavar="NAME=VALUE", help="Option of a diagnostic, such as step=68. Repeatable."),
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="Include slow diagnostics.")] = False,
    figures: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write a figure per diagnostic to this folder.")
    ] = None,
    format_: Annotated[
        str, typer.Option("--format", metavar="NAME", help="Format of the figures: svg, pdf or png.")
    ] = "svg",
    json: opt.Json = None,
) -> None:
    """Run diagnostics on traces of a filter.

    Prints the verdict and tables of every applicable diagnostic, and why the others do not apply. Several traces of
    one filter count as independent trajectories, which allows bounds and confidence intervals. Details:
    docs/diagnostics.md.

    \b
    Examples:
      beliefscope inspect run.trace
      beliefscope inspect runs/*.trace --only consistency --figures figures --format pdf
      beliefscope inspect run.trace --only saliency --option step=68 --option target=beta:image
      beliefscope inspect run.trace --filter mine.safetensors --all --json -
    """
    from beliefscope.app.protocol.diagnostic_options import parse_options
    from beliefscope.inspect.catalog import DIAGNOSTICS
    from beliefscope.inspect.diagnostics.plotting import FORMATS, write_figure

    for name in only or ():
        if name not in DIAGNOSTICS:
            raise unknown_name("diagnostic", name, DIAGNOSTICS)
    entries = {name: entry for name, entry in DIAGNOSTICS.items() if not only or name in only}
    values = _parse_options(options or (), {name for entry in entries.values() for name in entry.options})
    parsed = {
        name: parse_options(entry, {option: values[option] for option in entry.options if option in values})
        for name, entry in entries.items()
    }
    if format_ not in FORMATS:
        raise unknown_name("figure format", format_, FORMATS)
    opt.check_folder(figures, "--figures")
    traces, checkpoint = opt.open_traces(paths, filter_)
    with output.progress("Inspecting") as advance:
        results, reasons = _run(entries, traces, checkpoint, parsed, bool(every or only), advance)
    if not results:
        raise BadInput("; ".join(reasons.values()))
    if figures is not None:
        figures.mkdir(parents=True, exist_ok=True)
        for name, result in results.items():
            write_figure(result.plot(), figures / f"{name}.{format_}")
    text = [
        "\n\n".join([f"{DIAGNOSTICS[name].title}: {result.verdict}", *output.grids(result.tables())])
        for name, result in results.items()
    ]
    text += [f"{DIAGNOSTICS[name].title}: not available: {reason}" for name, reason in reasons.items()]
    document = {
        "task": traces[0].episode.task,
        "filter": traces[0].filter,
        "checkpoint_hash": traces[0].checkpoint_hash,
        "traces": [{"path": str(p), "episode": t.episode_index} for p, t in zip(paths, traces, strict=True)],
        "diagnostics": {name: result.to_dict() for name, result in results.items()},
        "not_made": reasons,
    }
    output.result(document, "\n\n".join(text), json)


def _run(
    entries: Mapping[str, Entry],
    traces: Sequence[Trace],
    checkpoint: Checkpoint | None,
    options: Mapping[str, Mapping[str, Any]],
    slow: bool,
    advance: Callable[[float], None],
) -> tuple[dict[str, Diagnostic], dict[str, str]]:
    """Results by diagnostic, and the reason for each one that was not run."""
    from beliefscope.app.protocol.diagnostic_options import takes_progress

    results: dict[str, Diagnostic] = {}
    reasons: dict[str, str] = {}
    for index, (name, entry) in enumerate(entries.items()):
        reason = next(filter(None, (entry.refusal(trace, checkpoint) for trace in traces)), None)
        if reason is None and entry.slow and not slow:
            reason = f"slow diagnostic; run it with --only {name} or --all"
        if reason is not None:
            reasons[name] = reason
        else:
            progress = {"progress": lambda share, index=index: advance((index + share) / len(entries))}
            extra = progress if takes_progress(entry) else {}
            results[name] = entry(traces, checkpoint, **options[name], **extra)
        advance((index + 1) / len(entries))
    return results, reasons


def _parse_options(texts: Iterable[str], names: Collection[str]) -> dict[str, str]:
    """Values by name of texts such as ``step=68``. Raises BadInput for malformed texts and unknown names."""
    values: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise BadInput(f"--option {text!r} has no value; write NAME=VALUE, such as step=68")
        if name not in names:
            raise unknown_name("option", name, sorted(names))
        values[name] = value
    return values
