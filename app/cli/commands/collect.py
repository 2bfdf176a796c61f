"""``beliefscope collect``"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from beliefscope.app.cli import options as opt
from beliefscope.app.cli import output as console

if TYPE_CHECKING:
    from beliefscope.datasets.statistics import Statistics

UNITS = ("cm", "mm", "deg", "N", "Nm")


def collect(
    task: opt.TaskName,
    output: opt.DatasetPath,
    episodes: Annotated[
        int | None,
        typer.Option(
            parser=opt.integer(1), metavar="N", help="Number of episodes. Default as in the paper: door 600, push 1000."
        ),
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(
            parser=opt.integer(2),
            metavar="T",
            help="Steps of 0.1 s per episode. Default as in the paper: door 800, push 250.",
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(parser=opt.integer(1), metavar="W", help="Processes. Default: one per CPU core.")
    ] = None,
    seed: opt.Seed = 0,
    json: opt.Json = None,
) -> None:
    """Simulate episodes and write them to an HDF5 file.

    The same seed gives the same data with any number of workers. An interrupted run resumes when the same command is
    run again. Of every ten episodes, eight are for training, one for validation and one for testing. The output
    compares the statistics of the dataset with those of the paper's.

    \b
    Example:
      beliefscope collect door --episodes 60 --steps 800 --seed 0 -o door.h5
    """
    from beliefscope.datasets.catalog import load_task
    from beliefscope.datasets.simulation.collect import collect as simulate
    from beliefscope.datasets.statistics import PAPER_DATA, default_size, statistics
    from beliefscope.datasets.store import open_dataset

    opt.check_output(output)
    name = load_task(task).name
    count, length = (value or default for value, default in zip((episodes, steps), default_size(name), strict=True))
    with console.progress(f"Simulating {name}") as advance:
        simulate(task, count, length, seed, workers, output, lambda done, total: advance(done / total))
    with open_dataset(output) as data:
        ours, paper = statistics(data.task, data), PAPER_DATA[name].statistics if name in PAPER_DATA else {}
        document = {
            "task": name,
            "episodes": len(data),
            "steps": length,
            "seed": seed,
            "contact_fraction": ours["contact_fraction"],
            "statistics": ours,
            "authors": paper,
            "data_hash": data.hash,
            "path": str(output),
            "bytes": output.stat().st_size,
        }
    summary = (
        f"{opt.path_and_size(output)}: {count} episodes of {length} steps, {ours['contact_fraction']:.0%} in contact"
    )
    console.result(document, f"{summary}\n\n{_statistics_table(ours, paper)}", json)


def _statistics_table(ours: Statistics, paper: Statistics) -> str:
    """Statistics of this dataset and of the paper's, and their ratio, per axis."""
    rows = []
    for name, value in ours.items():
        left, right = _axes(value), _axes(paper.get(name, []))
        ratios = [a / b for a, b in zip(left, right, strict=False)]
        rows.append([_label(name), _join(left, ".3g"), _join(right, ".3g"), _join(ratios, ".2f")])
    return console.grid("Statistics", ["", "this dataset", "paper", "ratio"], rows)


def _label(name: str) -> str:
    words, _, unit = name.replace("_", " ").rpartition(" ")
    return f"{words}, {unit}" if unit in UNITS else f"{words} {unit}"


def _axes(value: float | list[float]) -> list[float]:
    return value if isinstance(value, list) else [value]


def _join(numbers: list[float], number_format: str) -> str:
    return " ".join(format(number, number_format) for number in numbers)
