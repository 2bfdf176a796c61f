"""Routes under ``/api/diagnosis``: the probable cause of a fault, found by a job."""

from __future__ import annotations

from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Query
from fastapi.responses import Response

from beliefscope.app.api.jobs import result_or_job
from beliefscope.app.api.models.catalog import JobReply, Progress
from beliefscope.app.api.models.diagnosis import Diagnosis
from beliefscope.app.api.traces import RequestedRun
from beliefscope.app.jobs.queue import Jobs
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.trace_store import TraceStore

Over = Annotated[Literal["episode", "held-out"], Query(description="the run's episode, or held-out ones")]

MAX_EPISODES = 10
"""Held-out episodes of a diagnosis: more take longer and change little."""


def routes(store: TraceStore, jobs: Jobs) -> APIRouter:
    router = APIRouter()

    @router.get(
        "/api/diagnosis/{task}/{filter}/{episode}",
        response_model=Diagnosis,
        responses={202: {"model": JobReply | Progress}},
    )
    def get_diagnosis(selection: RequestedRun, over: Over = "episode") -> Response:
        return result_or_job(jobs, "diagnosis", _key(store, _arguments(store, selection, over)))

    @router.post("/api/diagnosis/{task}/{filter}/{episode}", status_code=202)
    def find_cause(selection: RequestedRun, over: Over = "episode") -> JobReply:
        arguments = _arguments(store, selection, over)
        episodes, faults = arguments["episodes"], arguments["faults"]
        scope = f"episode {selection.episode}" if over == "episode" else f"{len(episodes)} held-out episodes"
        title = ", ".join(filter(None, [f"Diagnosis of {selection.filter}", f"{selection.task} {scope}", faults]))
        query = {name: arguments[name] for name in ("task", "filter", "data", "faults") if arguments[name]}
        link = "?" + urlencode(query | {"episode": selection.episode, "over": over, "tab": "diagnosis"})
        return JobReply(job=jobs.submit("diagnosis", title, arguments, _key(store, arguments), link))

    return router


def _arguments(store: TraceStore, selection: Selection, over: str) -> dict[str, Any]:
    """Arguments of the job. Raises BadInput for an unknown name or invalid faults."""
    name, data = store.dataset(selection.task, selection.data)
    selection.faults.check(store.checkpoint(selection.task, selection.filter).task)
    held_out = [index for index in data.held_out() if index != selection.episode][: MAX_EPISODES - 1]
    return {
        "settings": store.settings.to_json(),
        "task": selection.task,
        "filter": selection.filter,
        "data": name,
        "faults": str(selection.faults),
        "episodes": [selection.episode, *(held_out if over == "held-out" else ())],
    }


def _key(store: TraceStore, arguments: dict[str, Any]) -> object:
    """Everything the result depends on."""
    task, filter_, data = names = [arguments[name] for name in ("task", "filter", "data")]
    hashes = (store.checkpoint(task, filter_).hash, store.dataset(task, data)[1].hash)
    return names, arguments["faults"], arguments["episodes"], hashes, store.settings.seed, store.settings.particles
