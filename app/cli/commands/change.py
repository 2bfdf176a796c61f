"""``beliefscope change``"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from beliefscope.app.cli import output as console
from beliefscope.app.cli.options import (
    DataPath,
    Json,
    Particles,
    Seed,
    SkipBad,
    check,
    checkpoint,
    dataset,
    is_path,
    serving,
)
from beliefscope.datasets.errors import BadInput

if TYPE_CHECKING:
    from beliefscope.filters.checkpoint import Checkpoint

Either = "A .safetensors file, or the name of a filter that ships for the other one's task, such as crossmodal-ekf."

SliceTexts = Annotated[
    list[str] | None,
    typer.Option(
        "--slice",
        metavar="SLICE",
        help="Look at this one too: NAME:faults=FAULTS:contact=yes:only=MODALITY, all but the name as needed. "
        "May be given several times.",
    ),
]


def change(
    before: Annotated[str, typer.Argument(metavar="BEFORE", help=Either)],
    after: Annotated[str, typer.Argument(metavar="AFTER", help=Either)],
    task_: Annotated[
        str | None, typer.Option("--task", metavar="TASK", help="Of both, where neither is a file.")
    ] = None,
    data: DataPath = None,
    skip_bad: SkipBad = False,
    slices: SliceTexts = None,
    particles: Particles = 300,
    seed: Seed = 0,
    output: Annotated[
        Path | None, typer.Option("-o", metavar="DIR", help="New folder for change.json, change.svg and change.md.")
    ] = None,
    json: Json = None,
) -> None:
    """Tell what a change of a filter mended and broke.

    Both checkpoints run over the held-out episodes with the same broken sensors and the same random numbers. Every
    error and every number of the belief before and after, by slice: nominal, contact, no contact, 80 % black pictures,
    each modality alone; with 95 % bootstrap intervals over episodes. Mended or damaged is what changed by 2 % or more
    with an interval that excludes no change. Then the moments that got worse, and what became of each module.

    \b
    Examples:
      beliefscope change crossmodal-ekf child.safetensors
      beliefscope change unimodal-ekf crossmodal-ekf --task push
      beliefscope change parent.safetensors child.safetensors --data door.h5 -o report
      beliefscope change crossmodal-pf child.safetensors --slice black-in-contact:faults=blackout=1:contact=yes
    """
    from beliefscope.app.protocol.permalinks import beside, moment_link
    from beliefscope.app.runs.catalog import served_names
    from beliefscope.filters.finetuning.slices import Slice, slices_of
    from beliefscope.inspect.compare.checkpoints import change_of
    from beliefscope.inspect.diagnostics.base import as_json

    check(None, json)
    if output is not None and (output.exists() or not output.parent.is_dir()):
        raise BadInput(f"output {str(output)!r} is there already, or its folder is not; give the name of a new folder")
    pair = both(before, after, task_)
    task = pair[0].task
    chosen = [Slice.parse(text, slices_of(task)) for text in slices or []]
    with dataset(task, data, skip_bad) as episodes, console.progress("Comparing") as advance:
        found = change_of(*pair, episodes, slices=chosen, particles=particles, seed=seed, progress=advance)
        data_hash = episodes.hash
    paths = [Path(text) for text in (before, after) if is_path(text)]
    named, data_name = served_names(paths, data)
    first, name = (named.get(str(Path(text)), text) for text in (before, after))
    weighed = pair[1].filter.architecture.fusion == "crossmodal"
    links = [
        beside(moment_link(task, name, data_name, m.episode, m.step, m.faults), m, first, weighed)
        for m in found.moments
    ]
    document = found.to_dict() | {
        "data_hash": data_hash,
        "frozen": list(found.frozen),
        "mended": as_json(found.mended()),
        "damaged": as_json(found.damaged()),
        "moments": [as_json(m) | {"link": link} for m, link in zip(found.moments, links, strict=True)],
        "serve": serving(paths, data, seed),
    }
    tables = [console.grid(one.title, one.columns, one.rows) for one in found.tables()]
    text = "\n\n".join([found.verdict, *tables])
    if output is not None:
        write(output, document, text, found.plot())
    console.result(document, text, json)


def both(before: str, after: str, task: str | None) -> tuple[Checkpoint, Checkpoint]:
    """Two checkpoints by file or by a name that ships for the task. Raises BadInput for what is not there."""
    from beliefscope.filters.checkpoint import load_checkpoint

    loaded = {text: load_checkpoint(Path(text)) for text in (before, after) if is_path(text)}
    if task is None and not loaded:
        raise BadInput(f"{before!r} and {after!r} are names of filters; say of which task: --task door")
    known = task or next(iter(loaded.values())).task.name
    first, second = (loaded.get(text) or checkpoint(known, text) for text in (before, after))
    return first, second


def write(folder: Path, document: dict[str, Any], text: str, figure: Any) -> None:
    """The report as numbers, as a figure and as text."""
    import json as json_format

    from beliefscope.datasets.io.atomic_write import write_atomically
    from beliefscope.inspect.diagnostics.plotting import write_figure

    folder.mkdir()
    write_figure(figure, folder / "change.svg")
    write_atomically(folder / "change.md", f"```\n{text}\n```\n".encode())
    write_atomically(folder / "change.json", (json_format.dumps(document, indent=2) + "\n").encode())
