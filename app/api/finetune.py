"""Routes under ``/api/finetune`` and ``/api/tuned``: options, runs and their results."""

import hashlib
import json
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal

from fastapi import Body, FastAPI, HTTPException
from fastapi.encoders import jsonable_encoder
from fastapi.responses import JSONResponse

from beliefscope.app.api.models import Encoded, Number, Progress, Reply, ResultViews, fields_of
from beliefscope.app.api.traces import RequestedRun
from beliefscope.app.api.weaknesses import Weakness, weaknesses_of
from beliefscope.app.jobs.finetune import catalog_name
from beliefscope.app.jobs.queue import Job, Jobs
from beliefscope.app.protocol.permalinks import page_link
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.workspace.finetune_runs import FineTuneRun, FineTuneRuns
from beliefscope.app.workspace.saved_filters import SavedFilter
from beliefscope.datasets.errors import BadInput
from beliefscope.filters.finetuning.choices import Choices, choices
from beliefscope.filters.finetuning.loop import Validation
from beliefscope.filters.finetuning.module_selection import select_parameters
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.filters.finetuning.success import measures
from beliefscope.filters.finetuning.training_data import simulated_episodes
from beliefscope.inspect.compare.effects import Regression
from beliefscope.inspect.compare.success import Success

Action = Literal["promote", "save", "discard"]


@dataclass(frozen=True)
class FineTuneRunInfo(FineTuneRun):
    """A fine-tuning run. finetuned: catalog name of its checkpoint. saved_as: its place in the catalog."""

    job: Job | None
    finetuned: str | None
    saved_as: Literal["saved", "default"] | None


class FineTuneProgress(Reply):
    """Progress of a fine-tuning run. losses: (step, loss)."""

    steps: int
    losses: list[tuple[int, Number]]
    validations: list[Encoded[Validation]]


class FineTunedCheckpoint(Reply):
    """A fine-tuned checkpoint.

    name, hash: of no meaning until the run has one (``FineTuneRunInfo.finetuned``). no_change: what to try, if the base
    checkpoint was best; else empty.
    """

    name: str
    hash: str
    best_step: int
    steps: int
    seconds: float
    no_change: str = ""


@fields_of(Regression)
class RegressionEvent(Reply):
    """Consecutive steps with a larger error than before."""

    link: str


class FineTuneResult(Reply):
    """Result of a fine-tuning run. frozen: modules with unchanged hashes. success: None without a criterion."""

    finetuned: FineTunedCheckpoint
    comparison: ResultViews
    frozen: list[str]
    events: list[RegressionEvent]
    success: Encoded[Success] | None = None


@dataclass(frozen=True)
class FineTuneRunSummary(FineTuneRunInfo):
    """A fine-tuning run with its progress and its outcome by the success criterion."""

    progress: FineTuneProgress | None
    success: Encoded[Success] | None


class MeasureInfo(Reply):
    """A measure of a success criterion. title: name of the quantity."""

    name: str
    title: str


@dataclass(frozen=True)
class FineTuneOffer(Choices):
    """Options for fine-tuning a filter, and runs of its task.

    simulated: number of training episodes that are simulated first; 0 if the data set has training episodes.
    """

    measures: list[MeasureInfo]
    simulated: int
    runs: list[FineTuneRunSummary]


@dataclass(frozen=True)
class FineTuneDetails(FineTuneRunInfo):
    """A fine-tuning run with its progress and result, which precedes the checkpoint."""

    progress: FineTuneProgress | None
    result: FineTuneResult | None


def add_routes(app: FastAPI, store: TraceStore, jobs: Jobs) -> None:
    runs = FineTuneRuns(store.settings.workspace)

    @app.get("/api/finetune/{task}/{filter}", response_model=FineTuneOffer)
    def get_options(task: str, filter: str, data: str = "") -> JSONResponse:
        listed = [summary(run) for run in runs.list_runs() if run.task == task]
        return JSONResponse(jsonable_encoder(_options(store, task, filter, data) | {"runs": listed}))

    @app.get("/api/weaknesses/{task}/{filter}/{episode}", responses={202: {"model": Progress}})
    def get_weaknesses(selection: RequestedRun) -> list[Weakness]:
        return weaknesses_of(store, jobs, selection)

    @app.post("/api/finetune/{task}/{filter}", status_code=202)
    def start(task: str, filter: str, settings: Annotated[dict[str, Any], Body()], data: str = "") -> FineTuneRunInfo:
        checkpoint = store.checkpoint(task, filter)
        tuning = FineTune.from_json(settings)
        select_parameters(checkpoint.filter, tuning.train, tuning.freeze)
        tuning.check_fit(checkpoint.filter)
        data, episodes = store.dataset(task, data)
        simulated_episodes(data, episodes, data not in store.settings.data)
        key = [filter, data, checkpoint.hash, episodes.hash, tuning.to_json(), store.settings.particles]
        id = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:16]
        run = runs.add(id, task, filter, data, tuning)
        arguments = {name: getattr(run, name) for name in ("run", "task", "filter", "data")}
        link = page_link(task=task, filter=filter, data=data, tab="finetune", run=id)
        slices = " and ".join(slice_.name for slice_, _ in tuning.mix) or "clean data"
        title = f"Fine-tuning of {filter}, {task}: {slices}"
        jobs.submit("finetune", title, arguments | {"tuning": run.settings}, id, link)
        return info(run)

    @app.get("/api/tuned/{run}", response_model=FineTuneDetails)
    def get_run(run: str) -> JSONResponse:
        return JSONResponse(details(runs.get(run)))

    @app.post("/api/tuned/{run}/{action}")
    def decide(run: str, action: Action) -> FineTuneRunInfo:
        record = runs.get(run)
        if (name := finetuned_name(record)) is None:
            raise HTTPException(409, f"Run {run!r} has no checkpoint yet to {action}.")
        result = runs.read(run, "result.json")
        reason = result["finetuned"].get("no_change", "") if result else ""
        if reason and action != "discard":
            raise HTTPException(409, f"Run {run!r} cannot be used as a new filter. {reason}")
        if action == "discard":
            store.saved.remove(record.task, name)
        else:
            path = str(runs.file(run, "finetuned.safetensors"))
            store.saved.save(SavedFilter(record.task, name, path, action == "promote"))
        return info(record)

    def summary(run: FineTuneRun) -> dict[str, Any]:
        listed = details(run)
        result = listed.pop("result")
        return listed | {"success": result and result.get("success")}

    def details(run: FineTuneRun) -> dict[str, Any]:
        current = info(run)
        # Not the job's result: a saved filter outlasts its job, which writes the result before it ends.
        has_result = current.finetuned or (current.job is not None and current.job.state == "running")
        result = runs.read(run.run, "result.json") if has_result else None
        return asdict(current) | {"progress": runs.read(run.run, "progress.json"), "result": result}

    def finetuned_name(run: FineTuneRun) -> str | None:
        """Catalog name of the run's checkpoint; None while there is none."""
        job, path = jobs.find("finetune", run.run), runs.file(run.run, "finetuned.safetensors")
        if (job is not None and job.active) or not path.is_file():
            return None
        return catalog_name(run.filter, hashlib.sha256(path.read_bytes()).hexdigest())

    def info(run: FineTuneRun) -> FineTuneRunInfo:
        name = finetuned_name(run)
        saved = {f.name: f for f in store.saved.all() if f.task == run.task}
        return FineTuneRunInfo(
            **vars(run),
            job=jobs.find("finetune", run.run),
            finetuned=name,
            saved_as=None if name not in saved else "default" if saved[name].default else "saved",
        )


def _options(store: TraceStore, task: str, filter_: str, data: str) -> dict[str, Any]:
    """What can be chosen for fine-tuning a filter on a data set."""
    checkpoint = store.checkpoint(task, filter_)
    options = dict(vars(choices(checkpoint)))
    name, episodes = store.dataset(task, data)
    titles = [{"name": key, "title": title} for key, title in measures(checkpoint.task).items()]
    try:
        simulated = simulated_episodes(name, episodes, name not in store.settings.data)
    except BadInput as error:
        return options | {"why_not": options["why_not"] or str(error), "measures": titles, "simulated": 0}
    return options | {"measures": titles, "simulated": simulated}
