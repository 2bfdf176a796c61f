"""Job that trains and evaluates the unfinished cells of a study."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from beliefscope.app.runs.worker import Report
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.text import percent
from beliefscope.filters.training.study import Cell, run_local


def run(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """Run the cells as ``beliefscope study`` does; it may run at the same time."""
    from beliefscope.recordings.study_figures import write_study  # imports matplotlib

    folder, preset = Path(arguments["folder"]), arguments["preset"]
    cells = [Cell(**values | {"data": Path(values["data"])}) for values in arguments["cells"]]
    unfinished = [cell for cell in cells if cell.finished(folder) is None]
    completed: list[Cell] = []

    def progress(cell: Cell) -> Callable[[str, int, int, float], None]:
        def update(stage: str, step: int, count: int, loss: float) -> None:
            report(len(completed) / len(unfinished), f"{cell}: {stage}, {percent(step / count)}, loss {loss:.3g}")

        return update

    errors: dict[str, str] = {}
    for cell, document in run_local(unfinished, folder, progress):
        completed.append(cell)
        if "error" in document:
            errors[str(cell)] = document["error"]
        write_study(folder, cells, preset)
    if errors:
        first, reason = next(iter(errors.items()))
        raise BadInput(f"{len(errors)} of {len(unfinished)} cells failed; the first, {first}: {reason}")
    return {"finished": [str(cell) for cell in completed]}
