"""Routes under ``/api/diagnosis``, ``/api/repair`` and ``/api/healthy-record``.

The probable cause of a fault is preliminary from a trace and confirmed by a job; a job searches the smallest repair.
Another job measures the healthy record of a filter that has none.
"""

import json
from dataclasses import asdict, replace
from typing import Annotated, Any, Literal

from fastapi import FastAPI, Query
from fastapi.responses import FileResponse, JSONResponse, Response

from beliefscope.app.api.jobs import arguments_over_episodes, result_or_job
from beliefscope.app.api.models import Encoded, JobReply, Number, Progress, Reply, fields_of
from beliefscope.app.api.traces import RequestedRun, finished_run
from beliefscope.app.jobs.queue import Jobs
from beliefscope.app.protocol.permalinks import page_link
from beliefscope.app.runs.live_runs import LIVE_PREFIX
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.text import plural
from beliefscope.inspect.diagnosis.cause import Candidate, Diagnosis as DiagnosisResult, Recovery
from beliefscope.inspect.diagnosis.diagnose import preliminary
from beliefscope.inspect.diagnosis.largest_error import LargestError
from beliefscope.inspect.diagnosis.undo.repair import check_repairable
from beliefscope.inspect.diagnostics.healthy_comparison import MIN_HEALTHY
from beliefscope.inspect.diagnostics.views import as_json
from beliefscope.inspect.healthy import MAX_EPISODES as MAX_RECORDED

Over = Annotated[Literal["episode", "held-out"], Query(description="the run's episode, or held-out ones")]

MAX_EPISODES = 10
"""Held-out episodes of a diagnosis: more take longer and change little."""


@fields_of(Candidate, "episodes", "steps", "evidence", "next")
class DiagnosisCause(Reply):
    """A ranked cause. cause: its name in the catalog. title: in words.

    steps: first affected step, and first step after it; None for complete episodes.
    """

    cause: str
    title: str
    component: str
    probability: float
    recovered: Encoded[Recovery] | None


@fields_of(DiagnosisResult, "state", "masked", "headline", "deviations")
class Diagnosis(Reply):
    """The probable causes of a filter's fault. masked: a sensor is faulty, and the filter is unaffected.

    deviations: largest ones, whatever their cause.
    miscalibrated: whether the healthy record itself is over- or underconfident, equations of the filter are wrong, or
        innovations are not wrapped.
    statistics: number of compared statistics by sensor, of the controls, labels, models and the filter.
    unmeasured: sensors without any, and statistics that the episodes or the healthy record do not have.
    outdated: whether an earlier version measured the healthy record, which lacks statistics.
    restarts: steps of the episodes at which a filter that diverges was restarted, or None.
    largest_error: of runs without a fault; None if the true state is unknown.
    runs: data sets of several live runs by the indices of their episodes; None for episodes of one data set.
    """

    causes: list[DiagnosisCause]
    task: str
    filter: str
    checkpoint_hash: str
    episodes: int
    healthy_episodes: int
    healthy_data: str = ""
    miscalibrated: bool
    statistics: dict[str, int]
    unmeasured: list[str]
    outdated: bool = False
    alarm_rate: float
    restarts: dict[int, list[int]] | None = None
    largest_error: Encoded[LargestError] | None = None
    runs: dict[int, str] | None = None


class DiagnosisJob(JobReply):
    """Body of a 202 response: the job, and the diagnosis of the selected run before any cause is undone."""

    preliminary: Diagnosis


class RepairedInterval(Reply):
    """The sensors to drop or restore, over the steps from the first to the last."""

    sensors: list[str]
    restored: bool
    steps: list[int]


class SmallestRepair(Reply):
    """The smallest repair of the largest failure of a run. failure: first and last step, None if there is none.

    error, repaired: RMS position error over the failure without and with the repair, m. bound: which it keeps, m.
    """

    sentence: str
    failure: list[int] | None
    bound: float
    error: Number
    repaired: Number
    repair: RepairedInterval | None
    replays: int


class HealthyRecord(Reply):
    """Which clean episodes the healthy record of a filter is from."""

    data: str


def add_routes(app: FastAPI, store: TraceStore, jobs: Jobs) -> None:
    @app.get(
        "/api/diagnosis/{task}/{filter}/{episode}",
        response_model=Diagnosis,
        responses={202: {"model": DiagnosisJob | Progress}},
    )
    def get_diagnosis(selection: RequestedRun, over: Over = "episode") -> Response:
        if over == "episode" and selection.data.startswith(LIVE_PREFIX):  # no data set, whose episodes a job could run
            store.live.ended_run(selection.data)
            return JSONResponse({"job": None, "preliminary": preliminary_diagnosis(store, selection)}, status_code=202)
        job = jobs.find("diagnosis", _arguments(store, selection, over))
        if path := jobs.finished_result(job):
            return FileResponse(path, media_type="application/json")
        first = preliminary_diagnosis(store, selection)
        if over == "episode" and first["state"] == "healthy":
            return JSONResponse(first)
        return JSONResponse({"job": job and asdict(job), "preliminary": first}, status_code=202)

    @app.post("/api/diagnosis/{task}/{filter}/{episode}", status_code=202)
    def find_cause(selection: RequestedRun, over: Over = "episode") -> JobReply:
        arguments = _arguments(store, selection, over)
        if over == "episode":
            scope = ""
        elif "selections" in arguments:
            scope = f"all {plural(len(arguments['selections']), 'run')}"
        else:
            scope = plural(len(arguments["episodes"]), "held-out episode")
        title = f"Diagnosis of {selection.describe(scope)}"
        link = replace(selection, data=arguments.get("data", selection.data)).link("diagnosis", over=over)
        return JobReply(job=jobs.submit("diagnosis", title, arguments, link=link))

    @app.get(
        "/api/repair/{task}/{filter}/{episode}", response_model=SmallestRepair, responses={202: {"model": JobReply}}
    )
    def get_repair(selection: RequestedRun) -> Response:
        return result_or_job(jobs, "repair", _repair_arguments(store, selection))

    @app.post("/api/repair/{task}/{filter}/{episode}", status_code=202)
    def search_repair(selection: RequestedRun) -> JobReply:
        check_repairable(store.checkpoint(selection.task, selection.filter))
        named = replace(selection, data=store.dataset(selection.task, selection.data)[0])
        link = named.link("diagnosis", over="episode")
        title = f"Smallest repair of {selection.describe()}"
        return JobReply(job=jobs.submit("repair", title, _repair_arguments(store, selection), link=link))

    @app.get("/api/healthy-record/{task}/{filter}", response_model=HealthyRecord, responses={202: {"model": JobReply}})
    def get_record(task: str, filter: str, data: str = "", healthy_filter: str = "") -> Response:
        """The healthy record that was measured for a filter, whatever the data, or the job that measures it."""
        job = jobs.find("healthy", _record_arguments(store, task, filter, data, healthy_filter))
        checkpoint = store.checkpoint(task, filter)
        if store.record_version(checkpoint) is None or (job and job.active):
            return JSONResponse({"job": job and asdict(job)}, status_code=202)
        record = checkpoint.healthy_profile or {}
        return JSONResponse({"data": str(record.get("data"))})

    @app.post("/api/healthy-record/{task}/{filter}", status_code=202)
    def measure_record(task: str, filter: str, data: str = "", healthy_filter: str = "") -> JobReply:
        """Measures the healthy record of a filter, also if it was measured before.

        healthy_filter: filter that runs over the healthy episodes, such as an earlier version; default: the filter.
        """
        arguments = _record_arguments(store, task, filter, data, healthy_filter)
        name, episodes = arguments["data"], plural(len(arguments["episodes"]), "held-out episode")
        if len(arguments["episodes"]) < MIN_HEALTHY:
            raise BadInput(f"{name!r} has {episodes}; a healthy record needs at least {MIN_HEALTHY}")
        by = f", run by {healthy_filter}" if healthy_filter else ""
        title = f"Healthy record of {filter}, {task}, {episodes} of {name}{by}"
        link = page_link(task=task, filter=filter, data=name, tab="diagnosis")
        job = jobs.submit("healthy", title, arguments, link=link, output_exists=False)  # a new job replaces the record
        return JobReply(job=job)


def available_diagnosis(store: TraceStore, jobs: Jobs, selection: Selection) -> Any:
    """The diagnosis of the run's episode as JSON values, preliminary if its job is not done.

    Raises BadInput without a healthy profile, and InProgress.
    """
    path = jobs.finished_result(jobs.find("diagnosis", _arguments(store, selection, "episode")))
    return preliminary_diagnosis(store, selection) if path is None else json.loads(path.read_bytes())


def preliminary_diagnosis(store: TraceStore, selection: Selection) -> Any:
    """The preliminary diagnosis as JSON values, kept with the run. Raises BadInput without a healthy profile."""
    run, particles = finished_run(store, selection), store.settings.particles
    result = run.result("diagnosis", lambda: as_json(preliminary(run.checkpoint, run.trace, particles).to_json()))
    return json.loads(result)


def _arguments(store: TraceStore, selection: Selection, over: str) -> dict[str, Any]:
    """Arguments of the job. Raises BadInput for an unknown name or invalid faults."""
    if over == "held-out" and selection.data.startswith(LIVE_PREFIX):
        return _arguments_of_runs(store, selection)
    name, data = store.dataset(selection.task, selection.data)
    checkpoint = store.checkpoint(selection.task, selection.filter)
    selection.faults.check(checkpoint.task)
    held_out = [index for index in data.held_out() if index != selection.episode][: MAX_EPISODES - 1]
    episodes = [selection.episode, *(held_out if over == "held-out" else ())]
    others = {"faults": str(selection.faults), "record": store.record_version(checkpoint)}
    return arguments_over_episodes(store, selection.task, selection.filter, name, episodes, **others)


def _arguments_of_runs(store: TraceStore, selection: Selection) -> dict[str, Any]:
    """Arguments of the job that diagnoses the ended live runs of a filter, as they are."""
    selections = store.live.of_same_filter(selection)
    return {
        "selections": [item.to_json() for item in selections],
        "keys": [store.key(item) for item in selections],
        "record": store.record_version(store.request(selection).checkpoint),
    }


def _repair_arguments(store: TraceStore, selection: Selection) -> dict[str, Any]:
    """Arguments of the job: the bound of its error is that of the healthy record."""
    record = store.record_version(store.checkpoint(selection.task, selection.filter))
    return {"selection": selection.to_json(), "key": store.key(selection), "record": record}


def _record_arguments(store: TraceStore, task: str, filter_: str, data: str, healthy_filter: str) -> dict[str, Any]:
    """Arguments of the job that measures a healthy record. Raises BadInput for an unknown name."""
    name, episodes = store.dataset(task, data)
    run = healthy_filter or filter_
    others = {"healthy_filter": run, "healthy_checkpoint": store.checkpoint(task, run).hash}
    return arguments_over_episodes(store, task, filter_, name, episodes.held_out()[:MAX_RECORDED], **others)
