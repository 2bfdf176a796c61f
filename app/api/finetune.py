"""Routes under ``/api/finetune`` and ``/api/tuned``: options, runs and their results."""

from __future__ import annotations

import hashlib
import json
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Body, HTTPException
from fastapi.responses import JSONResponse

from beliefscope.app.api.models.training import FineTuneDetails, FineTuneOffer, FineTuneRunInfo
from beliefscope.app.jobs.finetune import catalog_name
from beliefscope.app.jobs.queue import Jobs
from beliefscope.app.runs.saved_filters import SavedFilter, read_saved_filters, remove_filter, save_filter
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.workspace.finetune_runs import FineTuneRun, FineTuneRuns
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.external.load import ExternalFilter
from beliefscope.filters.finetuning.module_selection import (
    module_change,
    module_tree,
    presets,
    select_parameters,
    within,
)
from beliefscope.filters.finetuning.settings import FineTune
from beliefscope.filters.finetuning.slices import CLEAN, standard_slices

Action = Literal["promote", "save", "discard"]


def routes(store: TraceStore, jobs: Jobs) -> APIRouter:
    """Create the router."""
    router = APIRouter()
    runs = FineTuneRuns(store.settings.workspace)

    @router.get("/api/finetune/{task}/{filter}", response_model=FineTuneOffer, response_model_exclude_unset=True)
    def get_options(task: str, filter: str) -> dict[str, Any]:
        checkpoint = store.checkpoint(task, filter)
        return _options(checkpoint) | {"runs": [info(run) for run in runs.list_runs() if run.task == task]}

    @router.post("/api/finetune/{task}/{filter}", status_code=202)
    def start(task: str, filter: str, settings: Annotated[dict[str, Any], Body()], data: str = "") -> FineTuneRunInfo:
        checkpoint = store.checkpoint(task, filter)
        tuning = FineTune.from_json(settings)
        select_parameters(checkpoint.filter, tuning.train, tuning.freeze)
        for slice_, _ in tuning.mix:
            slice_.check(checkpoint.task, checkpoint.filter.names)
        data, _ = store.dataset(task, data)
        key = [filter, data, checkpoint.hash, store.data_hash(task, data), tuning.to_json(), store.settings.particles]
        id = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:16]
        run = runs.add(id, task, filter, data, tuning)
        arguments = {name: getattr(run, name) for name in ("run", "task", "filter", "data", "settings")}
        link = "?" + urlencode({"task": task, "filter": filter, "data": data, "tab": "finetune", "run": id})
        slices = " and ".join(slice_.name for slice_, _ in tuning.mix) or "clean data"
        title = f"Fine-tuning of {filter}, {task}: {slices}"
        jobs.submit("finetune", title, arguments | {"server": store.settings.to_json()}, id, link)
        return info(run)

    @router.get("/api/tuned/{run}", response_model=FineTuneDetails)
    def get_run(run: str) -> JSONResponse:
        current = info(runs.get(run))
        # Not the job's result: a saved filter outlasts its job.
        result = runs.read(run, "result.json") if current.finetuned else None
        progress = runs.read(run, "progress.json")
        return JSONResponse(current.model_dump() | {"progress": progress, "result": result})

    @router.post("/api/tuned/{run}/{action}")
    def decide(run: str, action: Action) -> FineTuneRunInfo:
        record = runs.get(run)
        name = finetuned_name(record)
        if name is None:
            raise HTTPException(409, f"Run {run!r} has no checkpoint yet to {action}.")
        if action == "discard":
            remove_filter(store, record.task, name)
        else:
            path = str(runs.file(run, "finetuned.safetensors"))
            save_filter(store, SavedFilter(record.task, name, path, action == "promote"))
        return info(record)

    def finetuned_name(run: FineTuneRun) -> str | None:
        """Catalog name of the run's checkpoint; None while there is none."""
        job, path = jobs.find("finetune", run.run), runs.file(run.run, "finetuned.safetensors")
        if (job is not None and job.active) or not path.is_file():
            return None
        return catalog_name(run.filter, hashlib.sha256(path.read_bytes()).hexdigest())

    def info(run: FineTuneRun) -> FineTuneRunInfo:
        name = finetuned_name(run)
        saved = {f.name: f for f in read_saved_filters(store.settings.workspace) if f.task == run.task}
        return FineTuneRunInfo(
            **vars(run),
            job=jobs.find("finetune", run.run),
            finetuned=name,
            saved_as=None if name not in saved else "default" if saved[name].default else "saved",
        )

    return router


def _options(checkpoint: Checkpoint) -> dict[str, Any]:
    """Modules, presets and slices for fine-tuning a filter."""
    if isinstance(checkpoint, ExternalFilter):
        reason = "External filters cannot be fine-tuned here."
        return {"why_not": reason, "modules": [], "presets": [], "slices": [], "settings": FineTune().to_json()}
    filter_ = checkpoint.filter
    changes = checkpoint.record.get("parts", {})  # of the fine-tuning that wrote this checkpoint
    modules = [
        {"name": n.name, "kind": n.kind, "description": n.description, "parameters": n.parameters, "depth": n.depth}
        | (module_change(n.name, changes) if any(within(key, n.name) for key in changes) else {})
        for n in module_tree(filter_)
        if n.name and n.parameters
    ]
    parameters = [name for name, _ in filter_.named_parameters()]
    trained = {name: set(select_parameters(filter_, [name])) for name in presets(filter_)}
    slices = [s for s in standard_slices(checkpoint.task) if s != CLEAN and set(s.only) <= set(filter_.names)]
    return {
        "why_not": None,
        "modules": modules,
        "presets": [{"name": n, "trains": [p for p in parameters if p in names]} for n, names in trained.items()],
        "slices": [slice_.to_json() | {"text": str(slice_)} for slice_ in slices],
        "settings": FineTune().to_json(),
    }
