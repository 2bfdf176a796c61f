"""Routes under ``/api/studies``: results of studies, and training of their unfinished cells."""

from collections.abc import Iterator, Mapping
from typing import Any
from urllib.parse import quote

from fastapi import FastAPI
from pydantic import ConfigDict

from beliefscope.app.api.models import FilterName, JobReply, Reply
from beliefscope.app.jobs.queue import Jobs
from beliefscope.app.protocol.errors import NotFound
from beliefscope.app.runs.result_filters import all_studies, result_filter_name
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.workspace.studies import Results, Study
from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.datasets.store import sample_path
from beliefscope.filters.names import is_code
from beliefscope.filters.training.plan import PLANS
from beliefscope.filters.training.study_table import Row

CatalogNames = Mapping[tuple[str, str], str]
"""(task, checkpoint hash) -> name of the filter in the catalog."""


class TrainedSeed(Reply):
    """A trained checkpoint of a study. file: whether it can be added to the catalog."""

    seed: int
    catalog_name: str | None
    file: bool


class StudyFilter(Reply):
    """A filter of a study and its trained checkpoints."""

    name: str
    trained: list[TrainedSeed]


class StudyTask(Reply):
    """The part of a study for one task.

    data: file of the training and evaluation data. offset_data: description of the data that rows with an offset start
    were evaluated on; empty: as the others.
    """

    model_config = ConfigDict(json_schema_serialization_defaults_required=True)  # optional fields of rows are sent

    name: str
    data: str
    offset_data: str
    filters: list[StudyFilter]
    rows: list[Row]


class StudyInfo(Reply):
    """A study. job: id of the job that trains its unfinished cells. why_not: why they cannot be trained here."""

    name: str
    preset: str
    seeds: int
    tasks: list[StudyTask]
    unfinished: int
    cells: int
    job: str | None
    why_not: str


class StudyList(Reply):
    """All studies. problems: one line per unreadable study."""

    studies: list[StudyInfo]
    problems: list[str]


def add_routes(app: FastAPI, store: TraceStore, jobs: Jobs) -> None:
    def studies() -> dict[str, Study]:
        return {study.name: study for study in all_studies(store.settings.studies, store.settings.workspace)}

    @app.get("/api/studies")
    def list_studies() -> StudyList:
        names = catalog_names(store)
        entries, problems = [], []
        for study in studies().values():
            try:
                entries.append(_info(study, study.read(), names, store, jobs))
            except BadInput as error:
                problems.append(str(error))
        return StudyList(studies=entries, problems=problems)

    @app.post("/api/studies/{name}/cells", status_code=202)
    def run_cells(name: str) -> JobReply:
        study = studies().get(name)
        if study is None:
            raise NotFound(f"Study {name!r} does not exist.")
        results = study.read()
        if not results.unfinished:
            raise BadInput(f"all cells of study {name!r} are finished")
        arguments, key = _job_arguments(study, results, store), _key(study, results)
        title, link = f"Cells of study {name}", f"?tab=study&study={quote(name)}"
        return JobReply(job=jobs.submit("study", title, arguments, key, link, output_exists=False))

    @app.post("/api/studies/{name}/{task}/{filter}/{seed}")
    def open_checkpoint(name: str, task: str, filter: str, seed: int) -> FilterName:
        study, cell = studies().get(name), f"{task}/{filter}/seed{seed}"
        hash_ = None if study is None else study.read().checkpoints.get(cell)
        if hash_ is None:
            raise NotFound(f"Study {name!r} has no checkpoint {cell!r}.")
        return add_filter(store, task, cell, hash_)


def _info(study: Study, results: Results, names: CatalogNames, store: TraceStore, jobs: Jobs) -> StudyInfo:
    job = jobs.find("study", _key(study, results))
    why_not = ""
    try:
        if results.unfinished:
            _job_arguments(study, results, store)
    except BadInput as error:
        why_not = str(error)
    return StudyInfo(
        name=study.name,
        preset=results.preset,
        seeds=results.seeds,
        tasks=_tasks(study, results, names),
        unfinished=len(results.unfinished),
        cells=len(results.cells),
        job=None if job is None else job.id,
        why_not=why_not,
    )


def _tasks(study: Study, results: Results, names: CatalogNames) -> list[StudyTask]:
    """The table's rows by task, and the checkpoints behind them."""

    def trained(task: str, filter_: str) -> Iterator[TrainedSeed]:
        for seed in range(results.seeds):
            cell = f"{task}/{filter_}/seed{seed}"
            if cell in results.checkpoints:
                name = names.get((task, results.checkpoints[cell]))
                file = study.has_checkpoints and study.checkpoint(cell).is_file()
                yield TrainedSeed(seed=seed, catalog_name=name, file=file)

    tasks = []
    for task in dict.fromkeys(row.task for row in results.rows):
        rows = [row for row in results.rows if row.task == task]
        filters = dict.fromkeys(row.filter for row in rows if row.blackout is not None)
        tasks.append(
            StudyTask(
                name=task,
                data=results.tasks.get(task, {}).get("data", ""),
                offset_data=results.tasks.get(task, {}).get("offset_data", ""),
                filters=[StudyFilter(name=name, trained=list(trained(task, name))) for name in filters],
                rows=rows,
            )
        )
    return tasks


def _job_arguments(study: Study, results: Results, store: TraceStore) -> dict[str, Any]:
    """Arguments of the job that finishes a study. Raises BadInput if this server lacks its preset or data."""
    if not study.has_checkpoints:
        raise BadInput("the built-in study cannot be continued; create one with beliefscope study")
    check_name("preset", results.preset, PLANS)
    settings = store.settings
    sources = {task.name: source for task, source in zip(settings.definitions, settings.tasks, strict=True)}
    files: dict[str, tuple[str, str]] = {}
    for task, info in results.tasks.items():
        data_hash = info.get("data_hash", "")
        served = store.datasets(task) if task in store.tasks() else {}
        name = next((name for name, data in served.items() if data.hash == data_hash), None)
        if name is None:
            data = f"{info.get('data', 'its data set')} ({data_hash[:8]})"
            raise BadInput(f"this server does not have {data}, the training data of {task}: serve it with --data")
        files[task] = str(settings.data.get(name) or sample_path(task)), data_hash
    cells = []
    for cell in results.cells:
        task, filter_, seed = cell.split("/")
        if task not in files:
            raise BadInput(f"study {study.name!r} does not name the training data of {task}")
        path, data_hash = files[task]
        given = results.given.get(filter_, "")
        if is_code(given):
            raise BadInput(f"filter {filter_!r} is code: continue with beliefscope study --filter {given}")
        number, source = int(seed.removeprefix("seed")), sources.get(task, task)
        cell_ = {"task": task, "filter": filter_, "seed": number, "preset": results.preset, "given": given}
        cells.append(cell_ | {"source": source, "data": path, "data_hash": data_hash})
    return {"folder": str(study.folder.resolve()), "preset": results.preset, "cells": cells}


def _key(study: Study, results: Results) -> object:
    return str(study.folder.resolve()), results.preset, sorted(results.cells)


def add_filter(store: TraceStore, task: str, name: str, hash_: str) -> FilterName:
    """Add a checkpoint to the catalog, if it is not there. name: in its sweep, or its cell in its study."""
    catalog_name = catalog_names(store).get((task, hash_)) or result_filter_name(name, hash_)
    store.checkpoint(task, catalog_name)  # adds it
    return FilterName(filter=catalog_name)


def catalog_names(store: TraceStore) -> CatalogNames:
    """Names of all filters in the catalog."""
    filters = {task: store.filters(task) for task in store.tasks()}
    return {(task, filter_.hash): name for task in filters for name, filter_ in filters[task].items()}
