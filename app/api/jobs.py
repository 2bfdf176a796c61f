"""Routes under ``/api/jobs``."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from fastapi import APIRouter
from fastapi.responses import FileResponse, JSONResponse, Response

from beliefscope.app.jobs.queue import Job, Jobs
from beliefscope.app.protocol.errors import NotFound
from beliefscope.app.runs.trace_store import TraceStore


@dataclass(frozen=True)
class JobWithLog(Job):
    """A job with the last lines of its output."""

    log: str = ""


def routes(jobs: Jobs) -> APIRouter:
    router = APIRouter()

    @router.get("/api/jobs")
    def list_jobs() -> list[Job]:
        return jobs.all()

    @router.get("/api/jobs/{id}")
    def get_job(id: str) -> JobWithLog:
        return JobWithLog(**asdict(jobs[id]), log=jobs.log(id))

    @router.delete("/api/jobs/{id}")
    def cancel_job(id: str) -> Job:
        return jobs.cancel(id)

    @router.get("/api/jobs/{id}/result")
    def job_result(id: str) -> FileResponse:
        job = jobs[id]
        path = jobs.finished_result(job)
        if path is None:
            raise NotFound(f"Job {id!r} has no result: it is {job.state}{job.error and f', {job.error}'}.")
        return FileResponse(path, media_type="application/json")

    return router


def arguments_over_episodes(
    store: TraceStore, task: str, filter_: str, data: str, episodes: list[int], **others: str
) -> dict[str, Any]:
    """Arguments of a job that runs a filter over episodes of a data set."""
    names = {"settings": store.settings.to_json(), "task": task, "filter": filter_, "data": data}
    return {**names, **others, "episodes": episodes}


def key_over_episodes(store: TraceStore, arguments: Mapping[str, Any]) -> object:
    """Everything that the result of a job over episodes of a data set depends on, given its arguments, except for a
    healthy record of the workspace.
    """
    task, filter_, data = (arguments[name] for name in ("task", "filter", "data"))
    hashes = store.checkpoint(task, filter_).hash, store.dataset(task, data)[1].hash
    others = [value for name, value in arguments.items() if name != "settings"]  # names occur in links
    return others, hashes, store.settings.seed, store.settings.particles


def result_or_job(jobs: Jobs, kind: str, key: object) -> Response:
    """The result of a finished job; else the response 202 with the job, or without one if it was not requested."""
    job = jobs.find(kind, key)
    if path := jobs.finished_result(job):
        return FileResponse(path, media_type="application/json")
    return JSONResponse({"job": None if job is None else asdict(job)}, status_code=202)
