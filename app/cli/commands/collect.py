"""``beliefscope collect``"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beliefscope.app.cli import output as console
from beliefscope.app.cli.options import Json, Seed, TaskName, check, size, whole

if TYPE_CHECKING:
    from beliefscope.datasets.statistics import Statistics

UNITS = ("cm", "mm", "deg", "N", "Nm")


def collect(
    task: TaskName,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE.h5", help="Where to write them.")],
    episodes: Annotated[
        int | None,
        typer.Option(
            "--episodes",
            parser=whole(1),
            metavar="N",
            help="How many to simulate. Without it: as many as the paper's authors, door 600, push 1000.",
        ),
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(
            "--steps",
            parser=whole(2),
            metavar="T",
            help="Length of each, 0.1 s a step. Without it: the authors', door 800, push 250.",
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", parser=whole(1), metavar="W", help="Processes. Without it: one a core.")
    ] = None,
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Simulate episodes into one HDF5 file.

    The same seed gives the same data, with any number of workers. A run that was killed goes on where it stopped
    when it is started again. Of every ten episodes eight are for training, one is for validation and one for tests.
    At the end the set's statistics stand beside those of the authors' data.

    \b
    Example:
      beliefscope collect door --episodes 60 --steps 800 --seed 0 -o door.h5
    """
    from beliefscope.datasets.catalog import load_task
    from beliefscope.datasets.simulation.collect import collect as simulate
    from beliefscope.datasets.statistics import AUTHORS, scale, statistics
    from beliefscope.datasets.store import open_dataset

    check(output, json)
    name = load_task(task).name
    count, length = (given or usual for given, usual in zip((episodes, steps), scale(name), strict=True))
    with console.progress(f"Simulating {name}") as advance:
        simulate(task, count, length, seed, workers, output, lambda done, of: advance(done / of))
    with open_dataset(output) as data:
        ours, authors = statistics(data.task, data), AUTHORS[name].statistics if name in AUTHORS else {}
        document = {
            "task": name,
            "episodes": len(data),
            "steps": length,
            "seed": seed,
            "contact_fraction": ours["contact_fraction"],
            "statistics": ours,
            "authors": authors,
            "data_hash": data.hash,
            "path": str(output),
            "bytes": output.stat().st_size,
        }
    contact = f"{ours['contact_fraction']:.0%} in contact"
    text = f"{size(output)}: {count} episodes of {length} steps, {contact}\n\n{_compared(ours, authors)}"
    console.result(document, text, json)


def _compared(ours: Statistics, authors: Statistics) -> str:
    """A table of both and of their ratio, axis by axis."""
    rows = [["", "this set", "authors", "ratio"]]
    for name, value in ours.items():
        here, there = _axes(value), _axes(authors.get(name, []))
        ratios = [a / b for a, b in zip(here, there, strict=False)]
        rows.append([_label(name), _row(here, ".3g"), _row(there, ".3g"), _row(ratios, ".2f")])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)


def _label(name: str) -> str:
    words, _, unit = name.replace("_", " ").rpartition(" ")
    return f"{words}, {unit}" if unit in UNITS else f"{words} {unit}"


def _axes(value: float | list[float]) -> list[float]:
    return value if isinstance(value, list) else [value]


def _row(numbers: list[float], form: str) -> str:
    return " ".join(format(number, form) for number in numbers)
