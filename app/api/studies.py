"""Results of studies over HTTP (docs/api.md): those that were given, those in the workspace, and the one that ships."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote

from fastapi import APIRouter, HTTPException
from pydantic import BaseModel, Field, FiniteFloat, ValidationError

from beliefscope.app.cli.commands.study import write
from beliefscope.app.jobs.queue import Job, Jobs
from beliefscope.app.jobs.worker import Report
from beliefscope.app.runs.catalog import short_names
from beliefscope.app.runs.trace_store import Library
from beliefscope.app.workspace.json_files import content
from beliefscope.datasets.catalog import load_task
from beliefscope.datasets.errors import BadInput, one_of
from beliefscope.datasets.store import sample_path
from beliefscope.filters.checkpoint import PRETRAINED, load_checkpoint
from beliefscope.filters.training.study import Cell, run_local
from beliefscope.filters.training.train import PLANS

SHIPPED = "shipped"
"""Name of the study that ships, whose first seed's weights do too."""

FILE = "study.json"

Numbers = Mapping[str, FiniteFloat | None]


class Line(BaseModel):
    """One line of a study's table, as ``filters.study.Row`` has it."""

    task: str
    filter: str
    blackout: FiniteFloat | None
    seeds: int
    asked: int
    failed: int
    mean: Numbers
    spread: Numbers
    bounds: tuple[FiniteFloat, FiniteFloat] | None = None
    each: Mapping[str, Numbers] = Field(default_factory=dict)


FINISHED = "finished"

Name = Annotated[str, Field(pattern=r"^[\w.+-]+/[\w.+-]+/seed\d+$")]
"""Of a cell: task/filter/seedK."""


class Results(BaseModel):
    """What a study's ``study.json`` says.

    checkpoints: hash of each cell that is trained; those of old studies have none. cells: how far each is.
    """

    preset: str
    tasks: Mapping[str, Mapping[str, str]]
    seeds: Annotated[int, Field(ge=1)]
    rows: list[Line]
    checkpoints: Mapping[str, str] = Field(default_factory=dict)
    cells: Mapping[Name, str] = Field(default_factory=dict)

    @property
    def left(self) -> list[str]:
        """The cells that are not finished."""
        return [name for name, state in self.cells.items() if state != FINISHED]


@dataclass(frozen=True)
class Study:
    """name: as shown. folder: of ``study.json``. checkpoints: whether that holds them too, in ``cells``."""

    name: str
    folder: Path
    checkpoints: bool

    def read(self) -> Results:
        """As it is now: a study may still go on. Raises BadInput where there is none, or no such."""
        path = self.folder / FILE
        try:
            return Results.model_validate_json(content(path))
        except OSError:
            raise BadInput(f"{str(self.folder)!r} is not the folder of a study: it has no {FILE}") from None
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"])) or "it"
            raise BadInput(f"{str(path)!r} does not hold a study's results: {where}: {first['msg']}") from None

    def checkpoint(self, cell: str) -> Path:
        return self.folder / "cells" / f"{cell}.safetensors"


def studies_of(given: Mapping[str, Path], workspace: Path) -> list[Study]:
    """Those that were given, by name; then those whose folders lie in the workspace, then the one that ships."""
    taken = {folder.resolve() for folder in given.values()}
    found = [path.parent for path in sorted(workspace.glob(f"*/{FILE}")) if path.parent.resolve() not in taken]
    named = {**given, **short_names(found, {*given, SHIPPED})}
    shown = [Study(name, folder, True) for name, folder in named.items()]
    return [*shown, Study(SHIPPED, PRETRAINED, False)]


def routes(library: Library, jobs: Jobs) -> APIRouter:
    """Every route under ``/api/studies``."""
    router = APIRouter()

    def known() -> list[Study]:
        return studies_of(library.settings.studies, library.settings.workspace)

    @router.get("/api/studies")
    def studies() -> dict[str, Any]:
        shelf = _by_hash(library)
        shown, problems = [], []
        for study in known():
            try:
                results = study.read()
                shown.append(document(study, results, shelf) | cells_left(study, results))
            except BadInput as error:
                problems.append(str(error))
        return {"studies": shown, "problems": problems}

    def cells_left(study: Study, results: Results) -> dict[str, Any]:
        job = jobs.find("study", _key(study, results))
        shown = {"left": len(results.left), "cells": len(results.cells), "job": job and job.id, "why_not": ""}
        try:
            if results.left:
                arguments_of(study, results, library)
        except BadInput as error:
            shown["why_not"] = str(error)
        return shown

    @router.post("/api/studies/{name}/cells", status_code=202)
    def run_cells(name: str) -> dict[str, Job]:
        study = next((one for one in known() if one.name == name), None)
        if study is None:
            raise HTTPException(404, f"Study {name!r} does not exist.")
        results = study.read()
        if not results.left:
            raise BadInput(f"all cells of study {name!r} are finished")
        arguments, key = arguments_of(study, results, library), _key(study, results)
        link = f"?tab=study&study={quote(name)}"
        return {"job": jobs.submit("study", f"Cells of study {name}", arguments, key, link, there=False)}

    @router.post("/api/studies/{name}/{task}/{filter}/{seed}")
    def open_checkpoint(name: str, task: str, filter: str, seed: int) -> dict[str, str]:
        study = next((one for one in known() if one.name == name), None)
        cell = f"{task}/{filter}/seed{seed}"
        wanted = None if study is None else study.read().checkpoints.get(cell)
        if study is None or wanted is None:
            raise HTTPException(404, f"Study {name!r} has no checkpoint {cell!r}.")
        there = _by_hash(library).get((task, wanted))
        if there is None:
            path = study.checkpoint(cell)
            checkpoint = load_checkpoint(path)
            if checkpoint.hash != wanted:
                raise BadInput(f"{str(path)!r} is not the checkpoint that study {name!r} measured")
            there = f"{name}-{filter}-seed{seed}"
            library.adopt(task, there, checkpoint, path, first=False)
        return {"filter": there}

    return router


def document(study: Study, results: Results, shelf: Mapping[tuple[str, str], str]) -> dict[str, Any]:
    """A study as the page shows it: its rows by task, and which of its checkpoints can be looked at.

    Args:
        shelf: task and hash -> name of a filter on the server's shelf.
    """

    def trained(task: str, filter_: str) -> Iterator[dict[str, Any]]:
        for seed in range(results.seeds):
            cell = f"{task}/{filter_}/seed{seed}"
            if cell in results.checkpoints:
                name = shelf.get((task, results.checkpoints[cell]))
                file = study.checkpoints and study.checkpoint(cell).is_file()
                yield {"seed": seed, "shelf": name, "file": file}

    tasks = []
    for task in dict.fromkeys(row.task for row in results.rows):
        rows = [row for row in results.rows if row.task == task]
        filters = {row.filter: None for row in rows if row.blackout is not None}
        tasks.append(
            {
                "name": task,
                "data": results.tasks.get(task, {}).get("data", ""),
                "filters": [{"name": name, "trained": list(trained(task, name))} for name in filters],
                "rows": [row.model_dump(exclude={"task"}) for row in rows],
            }
        )
    return {"name": study.name, "preset": results.preset, "seeds": results.seeds, "tasks": tasks}


def arguments_of(study: Study, results: Results, library: Library) -> dict[str, Any]:
    """Of the job that finishes a study's cells. Raises BadInput where this server lacks what they are made of."""
    if not study.checkpoints:
        raise BadInput("the study that ships is as it was measured: make one of your own with beliefscope study")
    if results.preset not in PLANS:
        raise one_of("preset", results.preset, PLANS)
    settings, catalog = library.settings, {task["name"]: task for task in library.catalog()["tasks"]}
    sources = {load_task(source).name: source for source in settings.tasks}
    files: dict[str, tuple[str, str]] = {}
    for task, known in results.tasks.items():
        wanted = known.get("data_hash", "")
        names = [data["name"] for data in catalog[task]["data"]] if task in catalog else []
        name = next((one for one in names if library.data_hash(task, one) == wanted), None)
        if name is None:
            told = f"{known.get('data', 'its data')} ({wanted[:8]})"
            raise BadInput(f"no data set of this server is {told}, on which {task} is trained: serve it with --data")
        files[task] = str(settings.data.get(name) or sample_path(task)), wanted
    cells = []
    for cell in results.cells:
        task, filter_, seed = cell.split("/")
        if task not in files:
            raise BadInput(f"study {study.name!r} does not say what {task} is trained on")
        path, digest = files[task]
        one = {"task": task, "filter": filter_, "seed": int(seed.removeprefix("seed")), "preset": results.preset}
        cells.append(one | {"source": sources.get(task, task), "data": path, "data_hash": digest})
    return {"folder": str(study.folder.resolve()), "preset": results.preset, "cells": cells}


def _key(study: Study, results: Results) -> str:
    named = (str(study.folder.resolve()), results.preset, sorted(results.cells))
    return hashlib.sha256(repr(named).encode()).hexdigest()


def work(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """The job that trains and measures what is left of a study, as ``beliefscope study`` does, and beside one."""
    folder, preset = Path(arguments["folder"]), arguments["preset"]
    cells = [Cell(**one | {"data": Path(one["data"])}) for one in arguments["cells"]]
    left = [cell for cell in cells if cell.finished(folder) is None]
    done: list[Cell] = []

    def progress(cell: Cell) -> Callable[[str, int, int, float], None]:
        def tell(stage: str, step: int, count: int, loss: float) -> None:
            report(len(done) / len(left), f"{cell}: {stage}, {step / count:.0%}, loss {loss:.3g}")

        return tell

    failed: dict[str, str] = {}
    for cell, document in run_local(left, folder, progress):
        done.append(cell)
        if "error" in document:
            failed[str(cell)] = document["error"]
        write(folder, cells, preset)
    if failed:
        first, why = next(iter(failed.items()))
        raise BadInput(f"{len(failed)} of {len(left)} cells failed; the first, {first}: {why}")
    return {"finished": [str(cell) for cell in done]}


def _by_hash(library: Library) -> dict[tuple[str, str], str]:
    """Task and hash -> name of every filter that the server shows."""
    tasks = library.catalog()["tasks"]
    return {(task["name"], one["checkpoint_hash"]): one["name"] for task in tasks for one in task["filters"]}
