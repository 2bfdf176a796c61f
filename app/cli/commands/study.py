from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from beliefscope.app.cli import console, options as opt
from beliefscope.datasets.errors import BadInput

if TYPE_CHECKING:
    from beliefscope.filters.training.plan import Report
    from beliefscope.filters.training.study import Cell


def study(
    output: Path = opt.option("DIR", "Study folder; created if missing.", ..., "-o", "--output"),
    preset: str = opt.option("NAME", "Training schedule: smoke, cpu or full.", "cpu"),
    tasks: list[str] | None = opt.option(
        "TASK", "Task to study. Repeatable. Default: door, push and the tasks with --data.", None, "--task"
    ),
    filters: list[str] | None = opt.option(
        "NAME|CHECKPOINT|FILE.py:FUNCTION",
        "Filter to train; or a checkpoint or an external filter, given by its build function, to evaluate only. "
        "Repeatable. Default: all filters of each task.",
        None,
        "--filter",
    ),
    seeds: int = opt.option("K", "Train each filter with seeds 0 to K - 1.", 3, parser=opt.integer(1)),
    data: list[str] | None = opt.option(
        "TASK=FILE", "Data of a task. Repeatable. Default: the sample set of the task.", None
    ),
    skip_bad: bool = False,
    engine: opt.Engine = "local",
    workers: int = opt.option("N", "Number of processes, each with one thread.", 1, parser=opt.integer(1)),
) -> console.Result:
    """Train and compare filters over many conditions.

    Trains each filter once per seed and evaluates it with 0, 40, 80 and 95 % image blackout on the test episodes, from
    starts at the truth and from offset starts. Writes checkpoints and metrics to DIR/cells, and updates DIR/table.md,
    table.csv, results.svg, results.pdf and results.png after each run. Completed runs are skipped, so the same command
    resumes an interrupted study, and several processes can share one DIR. Checkpoints and external filters given with
    --filter are evaluated only; each is a row with one seed.

    \b
    Examples:
      beliefscope study -o study
      beliefscope study --task door --filter crossmodal-ekf --filter lstm --seeds 5 -o study
      beliefscope study --task door --filter lstm --filter mine.safetensors --filter own_filter.py:build -o study
      beliefscope study --data push-real=mit_push --data door=door.h5 --preset full --engine ray -o /lab/study
    """
    from beliefscope.datasets.catalog import load_task
    from beliefscope.filters.training.study import run_cells, run_local, study_cells
    from beliefscope.filters.training.study_table import to_markdown
    from beliefscope.recordings.study_figures import write_study

    opt.check_folder(output, "output")
    opt.check_output(output / "table.md" if output.is_dir() else output)
    paths = opt.key_values(data or (), "--data", "TASK=FILE, such as door=door.h5")
    sources = {load_task(task).name: task for task in tasks or ()}
    files = {sources.get(name, name): Path(path) for name, path in paths.items()}
    for name, path in files.items():
        if tasks and name not in tasks:
            raise BadInput(f"--data '{name}={path}' is for task {name!r}, but the study is of {', '.join(tasks)}")
    cells = study_cells(preset, tasks or [], filters or [], seeds, files, skip_bad, console.note)
    folder = output.resolve()
    folder.mkdir(exist_ok=True)
    invalid: set[str] = set()
    finished = [cell for cell in cells if cell.finished(folder) is not None]
    remaining, done, total = [cell for cell in cells if cell not in finished], len(finished), len(cells)
    with console.bars() as update:

        def report(cell: Cell) -> Report:
            update("Cells", done / total, f"{done + 1} of {total}: {cell}")
            return lambda stage, step, steps, loss: update("Stage", step / steps, f"{stage}, loss {loss:.3g}")

        rows, overview = write_study(folder, cells, preset)
        update("Cells", done / total, f"{done} of {total}")
        here = engine == "local" and workers == 1
        results = run_local(remaining, folder, report) if here else run_cells(remaining, folder, engine, workers)
        for cell, document in results:
            done += 1
            update("Cells", done / total, f"{done} of {total}: {cell}")
            if "error" in document:
                console.note(f"failed: {cell}: {document['error']}")
                if document.get("invalid_input"):
                    invalid.add(str(cell))
            rows, overview = write_study(folder, cells, preset)
    failed = {name: state for name, state in overview["cells"].items() if state != "finished"}
    title = f"{folder / 'table.md'}: {total - len(failed)} of {total} cells finished"
    for name, state in list(failed.items())[:1]:
        console.note(f"error: {len(failed)} of {total} cells failed; the first: {name}: {state}")
    document = overview | {"path": str(output)}
    code = 0 if not failed else 2 if failed.keys() <= invalid else 1
    return console.Result(document, f"{title}\n\n{to_markdown(rows)}", code=code)
