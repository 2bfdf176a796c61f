"""Routes under ``/api/experiments``: results of sweeps, and checkpoints to open."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fastapi import FastAPI
from fastapi.responses import Response

from beliefscope.app.api.models import FilterName, Number, Reply
from beliefscope.app.api.studies import add_filter, catalog_names
from beliefscope.app.protocol.errors import NotFound
from beliefscope.app.runs.result_filters import sweep_folders
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.datasets.errors import BadInput
from beliefscope.inspect.diagnostics.views import as_json

if TYPE_CHECKING:
    from beliefscope.recordings.experiments import Experiments as Tables

LARGEST = 2000
"""Maximum number of rows that are sent."""


class SweepInfo(Reply):
    """A sweep. faults: texts, the empty one for clean data."""

    name: str
    checkpoints: int
    rows: int
    phases: list[str]
    faults: list[str]


class SweepList(Reply):
    """All sweeps. problems: one line per unreadable sweep."""

    sweeps: list[SweepInfo]
    problems: list[str]


class ExperimentRow(Reply):
    """Results of a checkpoint over a data set in one phase.

    checkpoint, data: hashes. catalog_name, data_name: their names in the catalog; None: not in it. data_file: name of
    the file or folder of the data. error, worst: in ``unit``, at ``worst_episode`` and ``worst_step``. components: RMSE
    of the components of the state, by name with the unit, such as ``angle_deg``. nll: nats, m, rad. worst_time: s since
    the first step of the episode; None without timestamps. training: JSON of the hash of its data, plan,
    blackouts, faults and the settings of a fine-tuning run. provenance: JSON of the file beside the checkpoint.
    """

    name: str
    filter: str
    task: str
    faults: str
    episodes: int
    steps: int
    error: Number
    unit: str
    components: dict[str, Number]
    nees: Number
    nll: Number
    coverage95: Number
    worst: Number
    worst_episode: int | None
    worst_step: int | None
    worst_time: Number
    checkpoint: str
    data: str
    training: str
    provenance: str
    catalog_name: str | None
    data_name: str | None
    data_file: str


class Experiments(Reply):
    """Results by checkpoint, largest errors first. count: number of all rows; only the first ones are sent."""

    rows: list[ExperimentRow]
    count: int


class EpisodeResult(Reply):
    """Results of an episode in one phase; error and worst in ``unit``, worst_time as in ``ExperimentRow``."""

    episode: int
    seed: int
    policy: str
    steps: int
    error: Number
    unit: str
    worst: Number
    worst_step: int
    worst_time: Number
    nees: Number


class EpisodeResults(Reply):
    """Results of a checkpoint by episode and seed, largest errors first. opened_seed: of the runs on the page."""

    episodes: list[EpisodeResult]
    opened_seed: int


def add_routes(app: FastAPI, store: TraceStore) -> None:
    def tables(name: str) -> Tables:
        from beliefscope.recordings.experiments import Experiments as Tables  # pyarrow and DuckDB are slow to import

        folder = sweep_folders(store.settings).get(name)
        if folder is None:
            raise NotFound(f"Sweep {name!r} does not exist.")
        return Tables([folder])

    @app.get("/api/experiments")
    def list_sweeps() -> SweepList:
        entries, problems = [], []
        for name in sweep_folders(store.settings):
            try:
                entries.append(_info(name, tables(name)))
            except BadInput as error:
                problems.append(str(error))
        return SweepList(sweeps=entries, problems=problems)

    @app.get("/api/experiments/{sweep}")
    def results(sweep: str, phase: str = "all") -> Experiments:
        from beliefscope.inspect.sweep import read_provenance  # imports torch

        @cache
        def standard_json(provenance: str) -> str:
            """The same for all rows of a checkpoint."""
            return json.dumps(read_provenance(provenance))

        experiments = tables(sweep)
        rows = experiments.overview(phase)
        files = {row["data"]: Path(row["path"]).name for row in experiments.query("FROM datasets").to_pylist()}
        names = catalog_names(store)
        components = experiments.components()

        def fields(row: dict[str, Any]) -> dict[str, Any]:
            """Fields of a row; the components that its task lacks are null."""
            errors = {name: row.pop(name) for name in components}
            return as_json(row | {"components": {name: error for name, error in errors.items() if error is not None}})

        tasks = set(rows["task"].to_pylist()) & set(store.tasks())
        data = {data.hash: name for task in tasks for name, data in store.datasets(task).items()}
        sent = [
            ExperimentRow(
                **fields(row) | {"provenance": standard_json(row["provenance"])},
                catalog_name=names.get((row["task"], row["checkpoint"])),
                data_name=data.get(row["data"]),
                data_file=files[row["data"]],
            )
            for row in rows.slice(0, LARGEST).to_pylist()
        ]
        return Experiments(rows=sent, count=len(rows))

    @app.get("/api/experiments/{sweep}/episodes")
    def episodes(sweep: str, checkpoint: str, data: str, faults: str = "", phase: str = "all") -> EpisodeResults:
        rows = tables(sweep).episodes(checkpoint, data, faults, phase).slice(0, LARGEST).to_pylist()
        results = [EpisodeResult(**as_json(row)) for row in rows]
        return EpisodeResults(episodes=results, opened_seed=store.settings.seed)

    @app.get("/api/experiments/{sweep}/results.csv")
    def results_as_csv(sweep: str, phase: str = "all") -> Response:
        from beliefscope.recordings.experiments import as_csv

        name = {"Content-Disposition": f'attachment; filename="results-{phase.replace(" ", "-")}.csv"'}
        return Response(as_csv(tables(sweep).overview(phase)), media_type="text/csv", headers=name)

    @app.post("/api/experiments/{sweep}/{checkpoint}")
    def open_checkpoint(sweep: str, checkpoint: str) -> FilterName:
        query = "SELECT task, name FROM checkpoints WHERE checkpoint = ?"
        row = next(iter(tables(sweep).query(query, [checkpoint]).to_pylist()), None)
        if row is None:
            raise NotFound(f"Sweep {sweep!r} has no checkpoint with hash {checkpoint[:12]}.")
        return add_filter(store, row["task"], row["name"], checkpoint)


def _info(name: str, tables: Tables) -> SweepInfo:
    size = "SELECT count(*) AS rows, count(DISTINCT checkpoint) AS checkpoints FROM results"
    (info,) = tables.query(size).to_pylist()
    faults = tables.query("SELECT DISTINCT faults FROM results ORDER BY faults")["faults"].to_pylist()
    return SweepInfo(name=name, phases=tables.phases(), faults=faults, **info)
