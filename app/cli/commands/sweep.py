from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from beliefscope.app.cli import console, options as opt
from beliefscope.datasets.text import plural

if TYPE_CHECKING:
    from beliefscope.inspect.sweep import Cell


def sweep(
    checkpoints: list[str] = opt.option(
        "GLOB|FILE.py:FUNCTION",
        "Checkpoints, such as 'runs/*.safetensors' (quoted), or an external filter, given by its build function, with "
        "@'runs/*.safetensors' for its weights. Repeatable.",
        ...,
        "--checkpoints",
    ),
    output: Path = opt.option("DIR", "Folder of the sweep; created if missing.", ..., "-o", "--output"),
    data: list[Path] | None = opt.option(
        "FILE.h5|DIR",
        "Episodes; each checkpoint runs over those of its task. Repeatable. Default: the sample set.",
        None,
    ),
    faults: list[str] | None = opt.option(
        "FAULTS", "Sensor faults, such as blackout=0.4; '' is clean data. Repeatable. Default: ''.", None
    ),
    seeds: int = opt.option("K", "Run with seeds 0 to K - 1.", 1, parser=opt.integer(1)),
    particles: int = 300,
    every: bool = False,
    skip_bad: bool = opt.flag("Skip unusable checkpoints and report the reasons.", "--skip-bad"),
    block: int = opt.option(
        "N", "Number of episodes in a cell, the unit of work that is stored.", 64, parser=opt.integer(1)
    ),
    engine: opt.Engine = "local",
    workers: int = 1,
) -> console.Result:
    """Run many checkpoints over many episodes and store a table.

    DIR/results.parquet has one row for each checkpoint, data set, faults, seed, episode and phase: errors, NEES/n,
    coverage, fusion weights and the provenance of the episode. DIR/checkpoints.parquet has one row for each checkpoint,
    with the provenance from the JSON file beside it (runs/a.json for runs/a.safetensors). Finished cells are stored, so
    the same command resumes an interrupted sweep. The tables are bit-identical for any engine and number of workers.
    Read them with beliefscope experiments, DuckDB, pandas or Polars (docs/sweep.md).

    \b
    Examples:
      beliefscope sweep --checkpoints 'runs/*.safetensors' --data door.h5 -o sweep
      beliefscope sweep --checkpoints 'runs/*.safetensors' --faults '' --faults blackout=0.8 --workers 8 -o sweep
      beliefscope sweep --checkpoints own.py:build --checkpoints 'runs/*.safetensors' --data own.h5 -o sweep
      beliefscope sweep --checkpoints 'own.py:build@runs/*.safetensors' --data own.h5 -o sweep
      beliefscope sweep --checkpoints '/lab/**/*.safetensors' --data /lab/door.h5 --engine ray -o /lab/sweep
    """
    opt.prepare_workers(engine, workers, "beliefscope.recordings.sweep_table")
    from beliefscope.inspect.sweep import Inputs, find_checkpoints
    from beliefscope.recordings.experiments import SHOWN, Experiments, labelled
    from beliefscope.recordings.sweep_table import run_sweep

    opt.check_folder(output, "output")
    files, texts = tuple(path.resolve() for path in data or ()), tuple(dict.fromkeys(faults or [""]))
    inputs = Inputs(find_checkpoints(checkpoints), files, texts, tuple(range(seeds)), particles, every)
    skipped: set[Path] = set()

    def skip(problem: str, paths: Sequence[Path]) -> None:
        console.note(f"skipped: {problem}")
        skipped.update(paths)

    cells = inputs.cells(block, skip=skip if skip_bad else None)
    opt.check_output(output / "results.parquet" if output.is_dir() else output)
    output.mkdir(exist_ok=True)
    _warn([path for path in inputs.checkpoints if path not in skipped], cells, output)
    console.note(f"{plural(len(cells), 'cell')}; if interrupted, the same command resumes")
    with console.bars() as update:
        table = run_sweep(
            cells,
            output.resolve(),
            engine=engine,
            workers=workers,
            progress=lambda done, total: update("Episodes", done / total, f"{done} of {total}"),
        )
    overview = Experiments([output]).overview()
    sizes = {"checkpoints": len(inputs.checkpoints), "cells": len(cells), "rows": len(table)}
    command = f"{shlex.join(['beliefscope', 'experiments', str(output)])} "
    text = console.arrow("Checkpoints, largest errors first", labelled(overview), SHOWN, command)
    return console.Result(sizes | {"overview": overview.to_pylist()}, text, output / "results.parquet")


def _warn(usable: Sequence[Path], cells: Sequence[Cell], output: Path) -> None:
    """Name usable checkpoints without cells, and the number of results in the tables that this sweep replaces."""
    from beliefscope.recordings.sweep_table import replaced_results

    used = {cell.checkpoint for cell in cells}
    if idle := [path.name for path in usable if path not in used]:
        console.note(f"Warning: no data of their tasks, or copies of other checkpoints: {', '.join(idle)}")
    if lost := replaced_results(cells, output):
        console.note(
            f"Warning: the tables in {output} will have the results of this command only, and lose "
            f"{plural(lost, 'other')}; to keep them, stop with Ctrl-C and add their checkpoints, data and faults, or "
            "choose another --output"
        )
