"""Routes under ``/api/diagnostics``: diagnostics of one episode, all held-out ones or all runs; slow ones as jobs."""

from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import Depends, FastAPI, HTTPException, Request
from fastapi.responses import JSONResponse, Response

from beliefscope.app.api.jobs import result_or_job
from beliefscope.app.api.models import JobReply, Progress, Reply, ResultViews, fields_of
from beliefscope.app.api.traces import IN_PROGRESS, RequestedRun, finished_run
from beliefscope.app.jobs.queue import Jobs
from beliefscope.app.protocol.errors import NotFound
from beliefscope.app.runs.live_runs import LIVE_PREFIX
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.runs.traced_run import TracedRun
from beliefscope.datasets.errors import unknown_name
from beliefscope.datasets.text import plural
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnostics.base import Entry

RUN_PARAMETERS = ("faults", "data", "episodes")
"""Query parameters that are not options of the diagnostic."""


class DiagnosticResult(ResultViews):
    """Result of a diagnostic over one or more episodes."""

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
    return _entry(name).parse_options({k: v for k, v in request.query_params.items() if k not in RUN_PARAMETERS})


@dataclass(frozen=True)
class DiagnosticRequest:
    """A diagnostic with its options, the selected run, and whether to compute it over other episodes instead."""

    entry: Annotated[Entry, Depends(_entry)]
    selection: RequestedRun
    options: Annotated[dict[str, Any], Depends(_options)]
    episodes: Literal["held-out"] | None = None


RequestedDiagnostic = Annotated[DiagnosticRequest, Depends()]
"""The diagnostic selected by path and query."""


def add_routes(app: FastAPI, store: TraceStore, jobs: Jobs) -> None:
    @app.get("/api/diagnostics", response_model=list[DiagnosticInfo])
    def list_diagnostics() -> list[dict[str, Any]]:
        return [entry.to_json() for entry in DIAGNOSTICS.values()]

    @app.get(
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

    @app.get(
        "/api/diagnostics/{name}/{task}/{filter}/{episode}",
        response_model=DiagnosticResult,
        responses={202: {"model": JobReply | Progress}},
    )
    def get_result(request: RequestedDiagnostic) -> Response:
        entry, options = request.entry, request.options
        run = finished_run(store, request.selection)
        _check(entry, run)
        if not (entry.slow or request.episodes):
            key = repr((entry.name, sorted(options.items())))
            result = run.result(
                key, lambda: {"trajectories": 1, **entry([run.trace], run.checkpoint, **options).views()}
            )
            return Response(result, media_type="application/json")
        return result_or_job(jobs, "diagnostic", _arguments(store, request, run))

    @app.post("/api/diagnostics/{name}/{task}/{filter}/{episode}", status_code=202)
    def compute(request: RequestedDiagnostic) -> JobReply:
        entry, selection = request.entry, request.selection
        run = store.request(selection)
        _check(entry, run)
        arguments = _arguments(store, request, run)
        unit = "run" if selection.data.startswith(LIVE_PREFIX) else "held-out episode"
        scope = f"all {plural(len(arguments['selections']), unit)}" if request.episodes else ""
        state = {"over": request.episodes, "diagnostic": entry.name, "options": urlencode(request.options)}
        title, link = f"{entry.title} of {selection.describe(scope)}", selection.link("diagnostics", **state)
        return JobReply(job=jobs.submit("diagnostic", title, arguments, link=link))


def _check(entry: Entry, run: TracedRun) -> None:
    if reason := entry.refusal(run.trace, run.checkpoint):
        raise HTTPException(409, reason)


def _arguments(store: TraceStore, request: DiagnosticRequest, run: TracedRun) -> dict[str, Any]:
    """Arguments of the job, with everything that its result depends on. run: the selected one."""
    selection = request.selection
    if not request.episodes:
        selections = [selection]
    elif selection.data.startswith(LIVE_PREFIX):
        selections = store.live.of_same_filter(selection)
    else:
        indices = store.dataset(selection.task, selection.data)[1].held_out()
        selections = [replace(selection, episode=index) for index in indices]
    return {
        "diagnostic": request.entry.name,
        "options": dict(sorted(request.options.items())),
        "selections": [item.to_json() for item in selections],
        "keys": [store.key(item) for item in selections],
        "record": store.record_version(run.checkpoint),
    }
