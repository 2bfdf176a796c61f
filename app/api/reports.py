"""Routes under ``/api/reports``: reports of runs, written by jobs and kept in the workspace."""

import hashlib
from dataclasses import replace
from typing import Annotated

from fastapi import Body, FastAPI, Request
from fastapi.responses import FileResponse, Response
from pydantic import Field, NonNegativeInt

from beliefscope.app.api.models import DeletedId, Freed, JobReply, Reply, RequestBody
from beliefscope.app.api.recordings import RunMatcher
from beliefscope.app.api.traces import RequestedRun
from beliefscope.app.jobs.queue import Jobs
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.workspace.reports import ReportEntry, ReportFolder
from beliefscope.app.workspace.trash import DeletedFile
from beliefscope.datasets.errors import BadInput
from beliefscope.inspect.maps.likelihood_map import Quantity
from beliefscope.recordings.report.pdf import browser

PAGE_POLICY = (
    "sandbox allow-popups; default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'"
)
"""Content security policy of a displayed report: no scripts; links open."""

MAX_EVENTS, MAX_TITLE = 20, 200


class ReportList(Reply):
    """Reports, newest first, and deleted ones."""

    reports: list[ReportEntry]
    deleted: list[DeletedFile]


class Name(Reply):
    """Name of a restored report."""

    name: str


class ReportRequest(RequestBody):
    """Body of ``POST /api/reports/...``; the same options as ``beliefscope report``.

    events: steps to show instead of the three worst. slow: include slow diagnostics. pdf: also write a PDF. quantity:
    of the maps; the other one if the filter does not have it.
    """

    events: list[NonNegativeInt] = Field(default=[], max_length=MAX_EVENTS)
    slow: bool = False
    pdf: bool = False
    title: Annotated[str, Field(max_length=MAX_TITLE)] = ""
    quantity: Quantity = "likelihood"


def add_routes(app: FastAPI, store: TraceStore, jobs: Jobs) -> None:
    reports = ReportFolder(store.settings.workspace / "reports")
    matcher = RunMatcher(store)

    @app.get("/api/reports")
    def list_reports() -> ReportList:
        listed = reports.list_reports()
        live = matcher.live_data() if listed else {}

        def with_names(entry: ReportEntry) -> ReportEntry:
            episode = entry.task, entry.episode, entry.data_hash
            data = live.get(episode) or matcher.data_name(*episode) if entry.data_hash else None
            return replace(
                entry, filter=matcher.filter_name(entry.filter, entry.checkpoint_hash, entry.task), data=data
            )

        return ReportList(reports=[*map(with_names, listed)], deleted=reports.trash.list_deleted())

    @app.post("/api/reports/{task}/{filter}/{episode}", status_code=202)
    def write_report(
        selection: RequestedRun, request: Request, options: Annotated[ReportRequest | None, Body()] = None
    ) -> JobReply:
        options = options or ReportRequest()
        if options.pdf:
            browser()  # raises BadInput without Chromium
        if options.events and (last := max(options.events)) >= (steps := len(store.request(selection))):
            raise BadInput(f"event step {last} does not exist: the run has steps 0 to {steps - 1}")
        url = str(request.base_url)
        key = repr((store.key(selection), selection.filter, selection.data, url, options.model_dump_json()))
        name = f"{selection.file_stem}-{hashlib.sha256(key.encode()).hexdigest()[:8]}"
        folder = reports.folder / name
        arguments = {
            "selection": selection.to_json(),
            "options": options.model_dump(),
            "url": url,
            "folder": str(folder),
        }
        title, link = f"Report of {selection.describe()}", f"api/reports/{name}.html"
        return JobReply(job=jobs.submit("report", title, arguments, link=link, output_exists=folder.is_dir()))

    @app.get("/api/reports/{name}.html", response_class=Response)
    def page(name: str, inline: bool = False) -> FileResponse:
        path = reports.page(name)
        disposition = "inline" if inline else "attachment"
        response = FileResponse(
            path, media_type="text/html; charset=utf-8", filename=f"{name}.html", content_disposition_type=disposition
        )
        response.headers["content-security-policy"] = PAGE_POLICY
        return response

    @app.get("/api/reports/{name}.pdf", response_class=Response)
    def pdf(name: str) -> FileResponse:
        path = reports.page(name, "report.pdf")
        return FileResponse(path, media_type="application/pdf", filename=f"{name}.pdf")

    @app.delete("/api/reports/{name}.html")
    def delete(name: str) -> DeletedId:
        return DeletedId(deleted=reports.trash.put(reports.page(name).parent))

    @app.post("/api/reports/deleted/{id}")
    def restore(id: str) -> Name:
        return Name(name=reports.trash.restore(id).name)

    @app.delete("/api/reports/deleted")
    def empty_trash() -> Freed:
        return Freed(freed=reports.trash.empty())
