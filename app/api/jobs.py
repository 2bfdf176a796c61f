"""Routes under ``/api/jobs``."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from fastapi import APIRouter, HTTPException
from fastapi.responses import FileResponse, JSONResponse, Response

from beliefscope.app.jobs.queue import Job, Jobs


@dataclass(frozen=True)
class JobWithLog(Job):
    """A job with the last lines of its output."""

    log: str = ""


def routes(jobs: Jobs) -> APIRouter:
    """Create the router."""
    router = APIRouter()

    def job_or_404(id: str) -> Job:
        try:
            return jobs[id]
        except KeyError:
            raise HTTPException(404, f"Job {id!r} does not exist.") from None

    @router.get("/api/jobs")
    def list_jobs() -> list[Job]:
        return jobs.all()

    @router.get("/api/jobs/{id}")
    def get_job(id: str) -> JobWithLog:
        return JobWithLog(**asdict(job_or_404(id)), log=jobs.log(id))

    @router.delete("/api/jobs/{id}")
    def cancel_job(id: str) -> Job:
        return jobs.cancel(job_or_404(id).id)

    @router.get("/api/jobs/{id}/result")
    def job_result(id: str) -> FileResponse:
        job = job_or_404(id)
        path = jobs.finished_result(job)
        if path is None:
            raise HTTPException(404, f"Job {id!r} has no result: it is {job.state}{job.error and f', {job.error}'}.")
        return FileResponse(path, media_type="application/json")

    return router


def result_or_job(jobs: Jobs, kind: str, key: object) -> Response:
    """The result of a finished job; else the response 202 with the job, or without one if it was not requested."""
    job = jobs.find(kind, key)
    if path := jobs.finished_result(job):
        return FileResponse(path, media_type="application/json")
    return JSONResponse({"job": None if job is None else asdict(job)}, status_code=202)
