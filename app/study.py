"""Results of studies over HTTP (docs/api.md): those that were given, those in the workspace, and the one that ships."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, HTTPException
from pydantic import BaseModel, Field, FiniteFloat, ValidationError

from beliefscope.app.library import Library
from beliefscope.app.shelf import short_names
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.checkpoint import PRETRAINED, load_checkpoint

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


class Results(BaseModel):
    """What a study's ``study.json`` says. checkpoints: task/filter/seedK -> hash; those of old studies have none."""

    preset: str
    tasks: Mapping[str, Mapping[str, str]]
    seeds: Annotated[int, Field(ge=1)]
    rows: list[Line]
    checkpoints: Mapping[str, str] = Field(default_factory=dict)


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
            return Results.model_validate_json(path.read_bytes())
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


def routes(library: Library) -> APIRouter:
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
                shown.append(document(study, shelf))
            except BadInput as error:
                problems.append(str(error))
        return {"studies": shown, "problems": problems}

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


def document(study: Study, shelf: Mapping[tuple[str, str], str]) -> dict[str, Any]:
    """A study as the page shows it: its rows by task, and which of its checkpoints can be looked at.

    Args:
        shelf: task and hash -> name of a filter on the server's shelf.
    """
    results = study.read()

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


def _by_hash(library: Library) -> dict[tuple[str, str], str]:
    """Task and hash -> name of every filter that the server shows."""
    tasks = library.catalog()["tasks"]
    return {(task["name"], one["checkpoint_hash"]): one["name"] for task in tasks for one in task["filters"]}
