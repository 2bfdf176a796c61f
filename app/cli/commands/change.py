"""``beliefscope change``"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from beliefscope.app.cli import options as opt
from beliefscope.app.cli import output as console
from beliefscope.app.runs.command_lines import is_path, serve_command
from beliefscope.datasets.errors import BadInput

if TYPE_CHECKING:
    from beliefscope.filters.checkpoint import Checkpoint

CHECKPOINT_HELP = "Path of a .safetensors file, or name of a built-in filter such as crossmodal-ekf."


def change(
    before: Annotated[str, typer.Argument(metavar="BEFORE", help=CHECKPOINT_HELP)],
    after: Annotated[str, typer.Argument(metavar="AFTER", help=CHECKPOINT_HELP)],
    task_: Annotated[
        str | None, typer.Option("--task", metavar="TASK", help="Task of both filters. Required for two names.")
    ] = None,
    data: opt.DataPath = None,
    skip_bad: opt.SkipBad = False,
    slices: opt.SliceTexts = None,
    particles: opt.Particles = 300,
    seed: opt.Seed = 0,
    output: Annotated[
        Path | None, typer.Option("-o", metavar="DIR", help="New folder for change.json, change.svg and change.md.")
    ] = None,
    json: opt.Json = None,
) -> None:
    """Report improvements and regressions between checkpoints.

    Runs both checkpoints over the held-out episodes with the same sensor faults and random numbers. Reports every
    error and covariance measure before and after, by data slice: clean, contact, free motion, 80 % image blackout,
    each modality only, and the slices given; with 95 % bootstrap intervals over episodes. A difference counts as
    improved or regressed if it is at least 2 % and its interval excludes zero. Also lists the events with the largest
    increase in error, and the change of each module.

    \b
    Examples:
      beliefscope change crossmodal-ekf finetuned.safetensors
      beliefscope change unimodal-ekf crossmodal-ekf --task push
      beliefscope change base.safetensors finetuned.safetensors --data door.h5 -o report
      beliefscope change crossmodal-pf finetuned.safetensors --slice blackout-in-contact:faults=blackout=1:contact=yes
    """
    from beliefscope.app.protocol.permalinks import comparison_permalink, permalink
    from beliefscope.app.runs.catalog import served_names
    from beliefscope.filters.finetuning.slices import Slice, standard_slices
    from beliefscope.inspect.compare.checkpoints import compare_checkpoints
    from beliefscope.inspect.diagnostics.views import as_json

    if output is not None and (output.exists() or not output.parent.is_dir()):
        raise BadInput(f"output {str(output)!r} exists, or its parent folder does not; give the name of a new folder")
    checkpoints = _open_both(before, after, task_)
    task = checkpoints[0].task
    selection = [Slice.parse(text, standard_slices(task)) for text in slices or []]
    with opt.open_episodes(task, data, skip_bad) as episodes, console.progress("Comparing") as advance:
        report = compare_checkpoints(
            *checkpoints, episodes, slices=selection, particles=particles, seed=seed, progress=advance
        )
        data_hash = episodes.hash
    paths = [Path(text) for text in (before, after) if is_path(text)]
    names, data_name = served_names(paths, data)
    first, second = (names.get(str(Path(text)), text) for text in (before, after))
    weighted = checkpoints[1].filter.architecture.fusion == "crossmodal"
    links = [
        comparison_permalink(permalink(task, second, data_name, m.episode, m.step, m.faults), m, first, weighted)
        for m in report.events
    ]
    document = report.to_dict() | {
        "data_hash": data_hash,
        "frozen": list(report.frozen),
        "improved": as_json(report.improvements()),
        "regressed": as_json(report.regressions()),
        "events": [as_json(m) | {"link": link} for m, link in zip(report.events, links, strict=True)],
        "serve": serve_command(paths, data, seed),
    }
    text = "\n\n".join([report.verdict, *console.grids(report.tables())])
    if output is not None:
        _write(output, document, text, report.plot())
    console.result(document, text, json)


def _open_both(before: str, after: str, task: str | None) -> tuple[Checkpoint, Checkpoint]:
    """Load two checkpoints by path or built-in name."""
    from beliefscope.filters.checkpoint import load_checkpoint

    files = {text: load_checkpoint(Path(text)) for text in (before, after) if is_path(text)}
    if task is None and not files:
        raise BadInput(f"{before!r} and {after!r} are filter names and need a task, such as --task door")
    name = task or next(iter(files.values())).task.name
    first, second = (files.get(text) or opt.open_checkpoint(name, text) for text in (before, after))
    return first, second


def _write(folder: Path, document: dict[str, Any], text: str, figure: Any) -> None:
    """Write the comparison as JSON, figure and Markdown."""
    import json as json_format

    from beliefscope.datasets.io.atomic_write import write_atomically
    from beliefscope.inspect.diagnostics.plotting import write_figure

    folder.mkdir()
    write_figure(figure, folder / "change.svg")
    write_atomically(folder / "change.md", f"```\n{text}\n```\n".encode())
    write_atomically(folder / "change.json", (json_format.dumps(document, indent=2) + "\n").encode())
