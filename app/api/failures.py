"""Routes under ``/api/failures``: failure events of a filter over a data set, found by a job."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import Depends, FastAPI
from fastapi.responses import JSONResponse, Response

from beliefscope.app.api.jobs import arguments_over_episodes, result_or_job
from beliefscope.app.api.models import Encoded, JobReply, Number, Progress, Reply, fields_of
from beliefscope.app.api.traces import finished_run
from beliefscope.app.jobs.failures import failure_document
from beliefscope.app.jobs.queue import Jobs
from beliefscope.app.protocol.permalinks import page_link
from beliefscope.app.runs.live_runs import LIVE_PREFIX
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.text import plural
from beliefscope.inspect.failures.by_episode import EpisodeErrors
from beliefscope.inspect.failures.events import Event, PhaseStatistics
from beliefscope.inspect.failures.survey_json import EVENT_FIELDS
from beliefscope.inspect.slices.report import ErrorSlice

Among = Literal["held-out", "all"]


@fields_of(PhaseStatistics)
class PhaseInfo(Reply):
    """The steps of a phase compared with all others."""

    over_represented: bool


@fields_of(Event, *EVENT_FIELDS)
class FailureEvent(Reply):
    """A failure event. error: per layer, m. link: the page's address that opens it. Times: s, or None."""

    value: Number
    nees: Number
    effective_weights: list[Number] | None
    link: str


class FailureSlices(Reply):
    """Data slices in which a score is larger. summary: their number and the searched data, or why there are none."""

    summary: str
    rows: list[Encoded[ErrorSlice]]


class FailureScore(Reply):
    """Failures ranked by one score. why_not: why the filter does not have it; the other fields are absent then."""

    name: str
    title: str
    unit: str
    display_unit: str
    scale: float
    why_not: str | None
    verdict: str | None = None
    threshold: Number = None
    total: int | None = None
    counts: dict[str, int] | None = None
    phases: list[PhaseInfo] | None = None
    events: list[FailureEvent] | None = None
    slices: FailureSlices | None = None


class Failures(Reply):
    """Failures of a filter over a data set."""

    task: str
    filter: str
    data: str
    faults: str
    among: Literal["held-out", "all"]
    particles: int | None
    steps: int
    layers: list[str]
    scores: list[FailureScore]
    episodes: list[Encoded[EpisodeErrors]]


@dataclass(frozen=True)
class SurveyRequest:
    """Names of a task, a filter and a data set, the episodes among which to search, and injected faults."""

    task: str
    filter: str
    data: str = ""
    among: Among = "held-out"
    faults: str = ""


RequestedSurvey = Annotated[SurveyRequest, Depends()]
"""The survey selected by path and query."""


def add_routes(app: FastAPI, store: TraceStore, jobs: Jobs) -> None:
    @app.get(
        "/api/failures/{task}/{filter}",
        response_model=Failures,
        response_model_exclude_unset=True,
        responses={202: {"model": JobReply | Progress}},
    )
    def get_failures(request: RequestedSurvey) -> Response:
        if request.data.startswith(LIVE_PREFIX):
            return _live_failures(store, request)
        return result_or_job(jobs, "failures", _arguments(store, request))

    @app.post("/api/failures/{task}/{filter}", status_code=202)
    def find_failures(request: RequestedSurvey) -> JobReply:
        arguments = _arguments(store, request)
        count, faults = len(arguments["episodes"]), arguments["faults"]
        scope = f"all {plural(count, 'episode')}" if request.among == "all" else plural(count, "held-out episode")
        title = ", ".join(filter(None, [f"Failures of {request.filter}", request.task, scope, faults]))
        state = {name: arguments[name] for name in ("task", "filter", "data", "among", "faults")}
        link = page_link(**state, tab="failures")
        return JobReply(job=jobs.submit("failures", title, arguments, link=link))


def found_failures(store: TraceStore, jobs: Jobs, selection: Selection) -> Path | None:
    """The result of the search over the held-out episodes with the filter, data and faults of a run, if done."""
    request = SurveyRequest(selection.task, selection.filter, selection.data, faults=str(selection.faults))
    return jobs.finished_result(jobs.find("failures", _arguments(store, request)))


def _live_failures(store: TraceStore, request: SurveyRequest) -> Response:
    """Failures of an ended live run, from its stored trace. Raises BadInput if it is still running."""
    faults = Faults.parse(request.faults)
    episode = store.live.ended_run(request.data).template.episode_index
    run = finished_run(store, Selection(request.task, request.filter, episode, faults, request.data))
    return JSONResponse(failure_document([run.trace], asdict(request) | {"faults": str(faults)}))


def _arguments(store: TraceStore, request: SurveyRequest) -> dict[str, Any]:
    """Arguments of the job. Raises BadInput for an unknown name or invalid faults."""
    faults = Faults.parse(request.faults)
    name, data = store.dataset(request.task, request.data)
    episodes = data.held_out() if request.among == "held-out" else list(range(len(data)))
    faults.check(store.checkpoint(request.task, request.filter).task, data.most_steps(episodes))
    others = {"among": request.among, "faults": str(faults)}
    return arguments_over_episodes(store, request.task, request.filter, name, episodes, **others)
