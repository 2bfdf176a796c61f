"""``beliefscope study``"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from beliefscope.app.cli import options as opt
from beliefscope.app.cli import output as console
from beliefscope.datasets.errors import BadInput, unknown_name

if TYPE_CHECKING:
    from beliefscope.filters.training.plan import Report
    from beliefscope.filters.training.study import Cell

ENGINES = ("local", "ray")


def study(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Study folder; created if missing.")],
    preset: Annotated[str, typer.Option(metavar="NAME", help="Training schedule: smoke, cpu or full.")] = "cpu",
    tasks: Annotated[
        list[str] | None,
        typer.Option("--task", metavar="TASK", help="Repeatable. Default: all built-in tasks and those with --data."),
    ] = None,
    filters: Annotated[
        list[str] | None,
        typer.Option("--filter", metavar="NAME", help="Repeatable. Default: all filters of each task."),
    ] = None,
    seeds: Annotated[
        int, typer.Option(parser=opt.integer(1), metavar="K", help="Train each filter with seeds 0 to K - 1.")
    ] = 3,
    data: Annotated[
        list[str] | None,
        typer.Option(metavar="TASK=FILE", help="Data of a task. Repeatable. Default: the built-in sample dataset."),
    ] = None,
    skip_bad: opt.SkipBad = False,
    engine: Annotated[
        str, typer.Option(metavar="NAME", help="local: one run at a time on this machine. ray: on a Ray cluster.")
    ] = "local",
    json: opt.Json = None,
) -> None:
    """Train and compare filters over many conditions.

    Trains each filter once per seed and evaluates it with 0, 40 and 80 % image blackout on the test episodes. Writes
    checkpoints and metrics to DIR/cells, and updates DIR/table.md, table.csv, results.svg and results.png after each
    run. Completed runs are skipped, so the same command resumes an interrupted study, and several processes can share
    one DIR.

    \b
    Examples:
      beliefscope study -o study
      beliefscope study --task door --filter crossmodal-ekf --filter lstm --seeds 5 -o study
      beliefscope study --data push-real=mit_push --data door=door.h5 --preset full --engine ray -o /lab/study
    """
    from beliefscope.filters.training.study import run_local, run_ray
    from beliefscope.filters.training.study_table import to_markdown
    from beliefscope.recordings.study_figures import write_study

    if engine not in ENGINES:
        raise unknown_name("engine", engine, ENGINES)
    opt.check_folder(output, "output")
    opt.check_output(output / "table.md" if output.is_dir() else output)
    cells = _cells(preset, tasks or [], filters or [], seeds, data or [], skip_bad)
    folder = output.resolve()
    folder.mkdir(exist_ok=True)
    finished = [cell for cell in cells if cell.finished(folder) is not None]
    remaining, done, total = [cell for cell in cells if cell not in finished], len(finished), len(cells)
    with console.bars() as update:

        def report(cell: Cell) -> Report:
            update("Cells", done / total, f"{done + 1} of {total}: {cell}")
            return lambda stage, step, steps, loss: update("Stage", step / steps, f"{stage}, loss {loss:.3g}")

        rows, overview = write_study(folder, cells, preset)
        update("Cells", done / total, f"{done} of {total}")
        for cell, document in run_ray(remaining, folder) if engine == "ray" else run_local(remaining, folder, report):
            done += 1
            update("Cells", done / total, f"{done} of {total}: {cell}")
            if "error" in document:
                console.note(f"failed: {cell}: {document['error']}")
            rows, overview = write_study(folder, cells, preset)
    failed = {name: state for name, state in overview["cells"].items() if state != "finished"}
    title = f"{folder / 'table.md'}: {total - len(failed)} of {total} cells finished"
    console.result(overview | {"path": str(output)}, f"{title}\n\n{to_markdown(rows)}", json)
    if failed:
        name, state = next(iter(failed.items()))
        console.fail(f"{len(failed)} of {total} cells failed; the first: {name}: {state}", 1)


def _cells(
    preset: str, tasks: list[str], filters: list[str], seeds: int, data: list[str], skip_bad: bool
) -> list[Cell]:
    """All cells by task, then seed, then filter, so that a table of all filters is available early.

    Raises BadInput for unknown names and unusable data.
    """
    from beliefscope.datasets.catalog import TASKS, load_task
    from beliefscope.datasets.store import sample_path
    from beliefscope.filters.catalog import filters_of
    from beliefscope.filters.training.plan import PLANS
    from beliefscope.filters.training.study import Cell

    if preset not in PLANS:
        raise unknown_name("preset", preset, PLANS)
    files = _data_files(data, tasks)
    sources = list(dict.fromkeys(tasks or [*(name for name in TASKS if name in files or _has_sample(name)), *files]))
    available = {name for source in sources for name in filters_of(load_task(source))}
    for name in filters:
        if name not in available:
            raise unknown_name("filter", name, sorted(available))
    cells = []
    for source in sources:
        task = load_task(source)
        path = (files[source] if source in files else sample_path(task.name)).resolve()
        with opt.open_episodes(task, path, skip_bad) as episodes:
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


def _data_files(texts: list[str], tasks: list[str]) -> dict[str, Path]:
    """File by task, from texts ``TASK=FILE``."""
    files: dict[str, Path] = {}
    for text in texts:
        name, equals, file = text.partition("=")
        if not equals or not file:
            raise BadInput(f"--data {text!r} is not TASK=FILE, such as door=door.h5")
        if tasks and name not in tasks:
            raise BadInput(f"--data {text!r} is for task {name!r}, but the study is of {', '.join(tasks)}")
        if name in files:
            raise BadInput(f"--data is given twice for task {name!r}")
        files[name] = Path(file)
    return files


def _has_sample(task: str) -> bool:
    from beliefscope.datasets.store import sample_path

    try:
        sample_path(task)
    except BadInput:
        return False
    return True
