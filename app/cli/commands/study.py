"""``beliefscope study``"""

from __future__ import annotations

import json as json_format
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from beliefscope.app.cli import output as console
from beliefscope.app.cli.options import Json, SkipBad, check, dataset, whole
from beliefscope.datasets.errors import BadInput, one_of

if TYPE_CHECKING:
    from beliefscope.filters.training.stages import Report
    from beliefscope.filters.training.study import Cell, Row

ENGINES = ("local", "ray")


def study(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the study; made if new.")],
    preset: Annotated[
        str,
        typer.Option("--preset", metavar="NAME", help="How long each filter trains: smoke, cpu, full."),
    ] = "cpu",
    tasks: Annotated[
        list[str] | None,
        typer.Option("--task", metavar="TASK", help="May be repeated. Without it: all that ship or are given data."),
    ] = None,
    filters: Annotated[
        list[str] | None,
        typer.Option("--filter", metavar="NAME", help="May be repeated. Without it: all filters of each task."),
    ] = None,
    seeds: Annotated[
        int, typer.Option("--seeds", parser=whole(1), metavar="K", help="Each filter trains with seeds 0 to K - 1.")
    ] = 3,
    data: Annotated[
        list[str] | None,
        typer.Option("--data", metavar="TASK=FILE", help="May be repeated. Without it: the sample set that ships."),
    ] = None,
    skip_bad: SkipBad = False,
    engine: Annotated[
        str, typer.Option("--engine", metavar="NAME", help="local: here, one by one. ray: on a Ray cluster.")
    ] = "local",
    json: Json = None,
) -> None:
    """Train and compare filters over many conditions.

    Each filter trains once with each seed, and is measured with 0, 40 and 80 % black pictures on the episodes kept for
    tests. Checkpoints and metrics lie in DIR/cells; DIR/table.md, table.csv, results.svg and results.png are written
    anew after each. What is done is not done again: the same command goes on after a kill, and several at once in one
    DIR share the work.

    \b
    Examples:
      beliefscope study -o study
      beliefscope study --task door --filter crossmodal-ekf --filter lstm --seeds 5 -o study
      beliefscope study --data push-real=mit_push --data door=door.h5 --preset full --engine ray -o /lab/study
    """
    from beliefscope.filters.training.study import run_local, run_ray, to_markdown

    check(None, json)
    if engine not in ENGINES:
        raise one_of("engine", engine, ENGINES)
    if output.exists() and not output.is_dir():
        raise BadInput(f"output {str(output)!r} is a file; give the name of a folder")
    check(output / "table.md" if output.is_dir() else output, None)
    cells = matrix(preset, tasks or [], filters or [], seeds, data or [], skip_bad)
    folder = output.resolve()
    folder.mkdir(exist_ok=True)
    finished = [cell for cell in cells if cell.finished(folder) is not None]
    left, done = [cell for cell in cells if cell not in finished], list(finished)

    with console.bars() as move:

        def report(cell: Cell) -> Report:
            move("Cells", len(done) / len(cells), f"{len(done) + 1} of {len(cells)}: {cell}")
            return lambda stage, step, count, loss: move("Stage", step / count, f"{stage}, loss {loss:.3g}")

        rows, overview = write(folder, cells, preset)
        move("Cells", len(done) / len(cells), f"{len(done)} of {len(cells)}")
        for cell, document in run_ray(left, folder) if engine == "ray" else run_local(left, folder, report):
            done.append(cell)
            move("Cells", len(done) / len(cells), f"{len(done)} of {len(cells)}: {cell}")
            if "error" in document:
                console.say(f"failed: {cell}: {document['error']}")
            rows, overview = write(folder, cells, preset)
    failed = {name: state for name, state in overview["cells"].items() if state != "finished"}
    title = f"{folder / 'table.md'}: {len(cells) - len(failed)} of {len(cells)} cells finished"
    console.result(overview | {"path": str(output)}, f"{title}\n\n{to_markdown(rows)}", json)
    if failed:
        name, state = next(iter(failed.items()))
        console.fail(f"{len(failed)} of {len(cells)} cells failed; the first: {name}: {state}", 1)


def matrix(
    preset: str, tasks: list[str], filters: list[str], seeds: int, data: list[str], skip_bad: bool
) -> list[Cell]:
    """All cells: by task, then seed, then filter, so that a first table of all filters is there early.

    Raises BadInput for unknown names, and for data that cannot be used.
    """
    from beliefscope.datasets.catalog import TASKS, load_task
    from beliefscope.datasets.store import sample_path
    from beliefscope.filters.catalog import filters_of
    from beliefscope.filters.training.study import Cell
    from beliefscope.filters.training.train import PLANS

    if preset not in PLANS:
        raise one_of("preset", preset, PLANS)
    files: dict[str, Path] = {}
    for given in data:
        name, equals, file = given.partition("=")
        if not equals or not file:
            raise BadInput(f"--data {given!r} is not TASK=FILE, such as door=door.h5")
        if tasks and name not in tasks:
            raise BadInput(f"--data {given!r} is for task {name!r}, but the study is of {', '.join(tasks)}")
        if name in files:
            raise BadInput(f"--data is given twice for task {name!r}")
        files[name] = Path(file)
    sources = list(dict.fromkeys(tasks or [*(name for name in TASKS if name in files or ships(name)), *files]))
    every = {name for source in sources for name in filters_of(load_task(source))}
    for name in filters:
        if name not in every:
            raise one_of("filter", name, sorted(every))
    cells = []
    for source in sources:
        task = load_task(source)
        path = (files[source] if source in files else sample_path(task.name)).resolve()
        with dataset(task, path, skip_bad) as episodes:
            data_hash, splits = episodes.hash, {summary.split for summary in episodes.summaries}
        if "train" not in splits or splits == {"train"}:
            raise BadInput(f"{path} has episodes of {', '.join(sorted(splits))}; a study needs train and test or val")
        cells += [
            Cell(task.name, name, seed, preset, source, path, data_hash, skip_bad)
            for seed in range(seeds)
            for name in filters_of(task)
            if not filters or name in filters
        ]
    return cells


def ships(task: str) -> bool:
    """Whether the task has a sample set."""
    from beliefscope.datasets.store import sample_path

    try:
        sample_path(task)
    except BadInput:
        return False
    return True


def write(folder: Path, cells: list[Cell], preset: str) -> tuple[list[Row], dict[str, Any]]:
    """Writes table, figure and overview of what is finished; returns the rows and the overview: what was asked for, how
    far each cell is, the hashes of what is trained, and the table's numbers, unrounded."""
    from dataclasses import asdict

    from beliefscope.datasets.io.atomic_write import write_atomically
    from beliefscope.filters.training.study import rows_of, to_csv, to_markdown
    from beliefscope.filters.training.train import versions
    from beliefscope.recordings.rerun_log.figures import write_results

    documents = {cell: cell.document(folder) for cell in cells}
    rows = rows_of(documents)
    write_atomically(folder / "table.md", to_markdown(rows).encode())
    write_atomically(folder / "table.csv", to_csv(rows).encode())
    write_results(rows, folder)
    overview = {
        "preset": preset,
        "tasks": {cell.task: {"data": cell.data.name, "data_hash": cell.data_hash} for cell in cells},
        "filters": list(dict.fromkeys(cell.filter for cell in cells)),
        "seeds": 1 + max(cell.seed for cell in cells),
        "versions": versions(),
        "cells": {str(c): "missing" if d is None else d.get("error", "finished") for c, d in documents.items()},
        "checkpoints": {str(c): d["checkpoint_hash"] for c, d in documents.items() if d and "error" not in d},
        "rows": [asdict(row) for row in rows],
    }
    write_atomically(folder / "study.json", json_format.dumps(overview, indent=1).encode())
    return rows, overview
