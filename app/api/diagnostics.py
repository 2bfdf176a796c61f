"""Routes under ``/api/diagnostics``: diagnostics of one episode or of all held-out episodes; slow ones as jobs."""

import json
import threading
from collections.abc import Mapping
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Depends, HTTPException, Request
from fastapi.responses import JSONResponse, Response

from beliefscope.app.api.jobs import result_or_job
from beliefscope.app.api.models import JobReply, Progress, Reply, ResultViews, fields_of
from beliefscope.app.api.traces import IN_PROGRESS, RequestedRun, finished_run
from beliefscope.app.jobs.queue import Jobs
from beliefscope.app.protocol.diagnostic_options import parse_options
from beliefscope.app.protocol.errors import NotFound
from beliefscope.app.protocol.permalinks import page_link
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.runs.traced_run import TracedRun
from beliefscope.datasets.errors import unknown_name
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnostics.base import Entry

RUN_PARAMETERS = ("faults", "data", "episodes")
"""Query parameters that are not options of the diagnostic."""


class DiagnosticResult(ResultViews):
    """Result of a diagnostic over one or more trajectories."""

    trajectories: int


class DiagnosticOption(Reply):
    """An option of a diagnostic; an empty default means none."""

    name: str
    meaning: str
    default: str


@fields_of(Entry, "name", "title", "question", "slow")
class DiagnosticInfo(Reply):
    """A diagnostic. slow: computed by a job."""

    options: list[DiagnosticOption]


class TraceDiagnosticInfo(DiagnosticInfo):
    """A diagnostic of one trace. why_not: why it is not available for this trace, or None."""

    why_not: str | None


def _entry(name: str) -> Entry:
    if name not in DIAGNOSTICS:
        raise NotFound(str(unknown_name("diagnostic", name, DIAGNOSTICS)))
    return DIAGNOSTICS[name]


def _options(name: str, request: Request) -> dict[str, Any]:
    return parse_options(_entry(name), {k: v for k, v in request.query_params.items() if k not in RUN_PARAMETERS})


RequestedEntry = Annotated[Entry, Depends(_entry)]
Options = Annotated[dict[str, Any], Depends(_options)]
Episodes = Literal["held-out"] | None


def routes(store: TraceStore, jobs: Jobs) -> APIRouter:
    router = APIRouter()
    computing = threading.Lock()  # one fast diagnostic at a time

    @router.get("/api/diagnostics", response_model=list[DiagnosticInfo])
    def list_diagnostics() -> list[dict[str, Any]]:
        return [entry.to_json() for entry in DIAGNOSTICS.values()]

    @router.get(
        "/api/diagnostics/{task}/{filter}/{episode}",
        response_model=list[TraceDiagnosticInfo],
        responses=IN_PROGRESS,
    )
    def list_trace_diagnostics(selection: RequestedRun) -> Response:
        run = finished_run(store, selection)
        entries = DIAGNOSTICS.values()
        return JSONResponse(
            [entry.to_json() | {"why_not": entry.refusal(run.trace, run.checkpoint)} for entry in entries]
        )

    @router.get(
        "/api/diagnostics/{name}/{task}/{filter}/{episode}",
        response_model=DiagnosticResult,
        responses={202: {"model": JobReply | Progress}},
    )
    def get_result(
        entry: RequestedEntry, selection: RequestedRun, options: Options, episodes: Episodes = None
    ) -> Response:
        run = finished_run(store, selection)
        _check(entry, run)
        if not (entry.slow or episodes):
            with computing:
                return Response(_result(entry, run, options), media_type="application/json")
        return result_or_job(jobs, "diagnostic", _key(store, entry, _selections(store, selection, episodes), options))

    @router.post("/api/diagnostics/{name}/{task}/{filter}/{episode}", status_code=202)
    def compute(
        entry: RequestedEntry, selection: RequestedRun, options: Options, episodes: Episodes = None
    ) -> JobReply:
        _check(entry, store.request(selection))
        selections = _selections(store, selection, episodes)
        arguments = {
            "settings": store.settings.to_json(),
            "diagnostic": entry.name,
            "options": options,
            "selections": [item.to_json() for item in selections],
        }
        title = f"{entry.title} of {selection.describe(f'all {len(selections)} held-out episodes' if episodes else '')}"
        key, link = _key(store, entry, selections, options), _link(entry, selection, options, episodes)
        return JobReply(job=jobs.submit("diagnostic", title, arguments, key, link))

    return router


def _result(entry: Entry, run: TracedRun, options: Mapping[str, Any]) -> bytes:
    """Result of a fast diagnostic as JSON, kept with the run."""
    key = repr((entry.name, sorted(options.items())))
    if key not in run.diagnostics:
        views = entry([run.trace], run.checkpoint, **options).views()
        run.diagnostics[key] = json.dumps({"trajectories": 1, **views}, allow_nan=False).encode()
    return run.diagnostics[key]


def _check(entry: Entry, run: TracedRun) -> None:
    if reason := entry.refusal(run.trace, run.checkpoint):
        raise HTTPException(409, reason)


def _selections(store: TraceStore, selection: Selection, episodes: Episodes) -> list[Selection]:
    return store.held_out(selection) if episodes else [selection]


def _key(store: TraceStore, entry: Entry, selections: list[Selection], options: Mapping[str, Any]) -> object:
    """Everything the result depends on, including the indices of the episodes."""
    traces = [(selection.episode, store.key(selection)) for selection in selections]
    version = store.record_version(selections[0].task, selections[0].filter)
    return entry.name, traces, sorted(options.items()), *((version,) if version else ())


def _link(entry: Entry, run: Selection, options: Mapping[str, Any], episodes: Episodes) -> str:
    """The page's address that shows the result."""
    query = {"task": run.task, "filter": run.filter, "data": run.data, "faults": str(run.faults), "over": episodes}
    parts = {"diagnostic": entry.name, "options": urlencode(options)}
    return page_link(**query, **parts, episode=run.episode, tab="diagnostics")
