"""Routes under ``/api/jobs``."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from fastapi import FastAPI
from fastapi.responses import FileResponse, JSONResponse, Response

from beliefscope.app.jobs.queue import Job, Jobs
from beliefscope.app.protocol.errors import NotFound
from beliefscope.app.runs.trace_store import TraceStore


@dataclass(frozen=True)
class JobWithLog(Job):
    """A job with the last lines of its output."""

    log: str = ""


def add_routes(app: FastAPI, jobs: Jobs) -> None:
    @app.get("/api/jobs")
    def list_jobs() -> list[Job]:
        return jobs.all()

    @app.get("/api/jobs/{id}")
    def get_job(id: str) -> JobWithLog:
        return JobWithLog(**asdict(jobs[id]), log=jobs.log(id))

    @app.delete("/api/jobs/{id}")
    def cancel_job(id: str, only_active: bool = False) -> Job:
        """Cancels an active job, or deletes an ended one: a page that displays it as active wants only the former."""
        return jobs.cancel(id, only_active)

    @app.get("/api/jobs/{id}/result")
    def job_result(id: str) -> FileResponse:
        job = jobs[id]
        path = jobs.finished_result(job)
        if path is None:
            raise NotFound(f"Job {id!r} has no result: it is {job.state}{job.error and f', {job.error}'}.")
        return FileResponse(path, media_type="application/json")


def arguments_over_episodes(
    store: TraceStore, task: str, filter_: str, data: str, episodes: list[int], **others: Any
) -> dict[str, Any]:
    """Arguments of a job that runs a filter over episodes of a data set, with everything that its result depends on.

    others: further arguments, such as the version of the healthy record where the result depends on it.
    """
    hashes = store.checkpoint(task, filter_).hash, store.dataset(task, data)[1].hash
    settings = {"hashes": hashes, "seed": store.settings.seed, "particles": store.settings.particles}
    return {"task": task, "filter": filter_, "data": data, **others, "episodes": episodes, **settings}


def result_or_job(jobs: Jobs, kind: str, arguments: Mapping[str, Any]) -> Response:
    """The result of a finished job; else the response 202 with the job, or without one if it was not requested."""
    job = jobs.find(kind, arguments)
    if path := jobs.finished_result(job):
        return FileResponse(path, media_type="application/json")
    return JSONResponse({"job": None if job is None else asdict(job)}, status_code=202)
