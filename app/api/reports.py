"""Reports over HTTP (docs/api.md): of the run that the page shows, made by a job, kept in the workspace."""

from __future__ import annotations

import hashlib
import re
import threading
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Body, Request
from fastapi.responses import FileResponse, Response
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from beliefscope.app.api.traces import Asked
from beliefscope.app.cli.commands.report import report_command, trace_command
from beliefscope.app.cli.options import serving
from beliefscope.app.jobs.queue import Job, Jobs
from beliefscope.app.jobs.worker import Report
from beliefscope.app.protocol.etag import tagged_json
from beliefscope.app.protocol.permalinks import moment_link
from beliefscope.app.runs.trace_store import Library, Selection, Settings
from beliefscope.app.server.security import kept_file
from beliefscope.app.workspace.json_files import read_record
from beliefscope.app.workspace.trash import Deleted, Gone, Trash, size
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.faults.injection import Faults
from beliefscope.recordings.report.pdf import browser, print_page

NAME = re.compile(r"[\w.+-]+-episode\d+-[0-9a-f]{8}")

PAGE_POLICY = (
    "sandbox allow-popups; default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'"
)
"""What a report may do that is opened here: show itself, and have its links followed."""


MOST_MOMENTS, LONGEST_TITLE = 20, 200


class ReportRequest(BaseModel):
    """Body of ``POST /api/reports/...``, as ``beliefscope report`` takes it.

    Moments: steps that are shown in place of the three worst. Every: slow diagnostics as well. Pdf: printed, too.
    """

    model_config = ConfigDict(extra="forbid", strict=True)
    moments: Annotated[list[Annotated[int, Field(ge=0)]], Field(max_length=MOST_MOMENTS)] = []
    every: bool = False
    pdf: bool = False
    title: Annotated[str, Field(max_length=LONGEST_TITLE)] = ""


class _Run(BaseModel):
    episode: int
    faults: Any


class Manifest(BaseModel):
    """What is read of a report's manifest (``recordings.report``). Made: when, ISO 8601. Files: their SHA-256."""

    title: str
    made: str
    task: str
    filter: str
    traces: Annotated[list[_Run], Field(min_length=1, max_length=1)]
    files: dict[str, str]


MANIFEST = TypeAdapter(Manifest)


class Reports:
    """The reports of a workspace. Methods may be called from any thread, and block."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._trash = Trash(folder)
        self._lock = threading.Lock()
        self._known: dict[str, tuple[int, dict[str, Any]]] = {}  # name -> (ns at which it was made, what it is)

    def all(self) -> list[dict[str, Any]]:
        """The newest first."""
        with self._lock:
            found = [
                self._shown(path) for path in self.folder.glob("*/manifest.json") if NAME.fullmatch(path.parent.name)
            ]
        return sorted((one for one in found if one), key=lambda one: one["made"], reverse=True)

    def page(self, name: str, file: str = "report.html") -> Path:
        """Raises Gone where there is no such report, or it has no such page."""
        path = self.folder / name / file
        whole = kept_file(self.folder, f"{name}/{file}")
        if not NAME.fullmatch(name) or path.parent.is_symlink() or whole is None:
            raise Gone(f"Report {name!r} is not there, or no longer.")
        return path

    def delete(self, name: str) -> str:
        """Into the trash; gives the id by which it is had back. Raises Gone."""
        with self._lock:
            return self._trash.put(self.page(name).parent)

    def restore(self, id: str) -> str:
        """Gives its name. Raises Gone, and Taken where it has been made again."""
        with self._lock:
            return self._trash.restore(id, self.folder).name

    def deleted(self) -> list[Deleted]:
        """The last first."""
        with self._lock:
            return self._trash.all()

    def empty(self) -> None:
        """Deletes for good what is in the trash."""
        with self._lock:
            self._trash.empty()

    def _shown(self, manifest: Path) -> dict[str, Any] | None:
        """What its manifest says, read once; None where that cannot be read."""
        name = manifest.parent.name
        with suppress(OSError, ValueError, LookupError, TypeError, AttributeError):
            made = manifest.stat().st_mtime_ns
            if name not in self._known or self._known[name][0] != made:
                said = read_record(MANIFEST, manifest)
                shown = said.model_dump(include={"title", "made", "task", "filter"})
                shown |= {"episode": said.traces[0].episode, "faults": str(Faults.of(said.traces[0].faults))}
                shown |= {"name": name, "url": f"/api/reports/{name}.html", "bytes": size(manifest.parent)}
                shown["pdf"] = f"/api/reports/{name}.pdf" if "report.pdf" in said.files else None
                self._known[name] = made, shown
            return self._known[name][1]
        return None


def routes(library: Library, jobs: Jobs) -> APIRouter:
    """Every route under ``/api/reports``."""
    router = APIRouter()
    reports = Reports(library.settings.workspace / "reports")

    @router.get("/api/reports")
    def list_reports(request: Request) -> Response:
        shown = {"reports": reports.all(), "deleted": [asdict(one) for one in reports.deleted()]}
        return tagged_json(request, shown)

    @router.post("/api/reports/{task}/{filter}/{episode}", status_code=202)
    def make(asked: Asked, request: Request, wanted: Annotated[ReportRequest | None, Body()] = None) -> dict[str, Job]:
        wanted = wanted or ReportRequest()
        _check(library, asked, wanted)
        url = str(request.base_url)
        key = repr((library.key(asked), asked.filter, asked.data, url, wanted.model_dump_json()))
        short = hashlib.sha256(key.encode()).hexdigest()[:8]
        name = f"{asked.stem}-{short}"
        folder = reports.folder / name
        arguments = {
            "settings": library.settings.to_json(),
            "selection": asked.to_json(),
            "wanted": wanted.model_dump(),
            "url": url,
            "folder": str(folder),
        }
        return {
            "job": jobs.submit(
                "report", f"Report of {asked.told}", arguments, key, f"api/reports/{name}.html", folder.is_dir()
            )
        }

    @router.get("/api/reports/{name}.html")
    def page(name: str, shown: bool = False) -> Response:
        path = reports.page(name)
        way = "inline" if shown else "attachment"
        answer = FileResponse(
            path, media_type="text/html; charset=utf-8", filename=f"{name}.html", content_disposition_type=way
        )
        answer.headers["content-security-policy"] = PAGE_POLICY
        return answer

    @router.get("/api/reports/{name}.pdf")
    def printed(name: str) -> Response:
        path = reports.page(name, "report.pdf")
        return FileResponse(path, media_type="application/pdf", filename=f"{name}.pdf")

    @router.delete("/api/reports/{name}.html")
    def delete(name: str) -> dict[str, str]:
        return {"deleted": reports.delete(name)}

    @router.post("/api/reports/deleted/{id}")
    def restore(id: str) -> dict[str, str]:
        return {"name": reports.restore(id)}

    @router.delete("/api/reports/deleted")
    def empty() -> dict[str, int]:
        freed = sum(one.bytes for one in reports.deleted())
        reports.empty()
        return {"freed": freed}

    return router


def _check(library: Library, asked: Selection, wanted: ReportRequest) -> None:
    """Raises BadInput for a step that the run has not, and for a PDF where nothing can print one."""
    if wanted.pdf:
        browser()
    if wanted.moments and (last := max(wanted.moments)) >= (steps := len(library.traced(asked))):
        raise BadInput(f"moment {last} does not exist: the run has steps 0 to {steps - 1}")


def work(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """The job of a report: its folder. What was traced before is read, not traced again."""
    from beliefscope.recordings.report.compose import compose, write_report  # bring Rerun

    wanted = ReportRequest(**arguments["wanted"])
    library = Library(Settings.of_json(arguments["settings"]))
    try:
        of = Selection.of_json(arguments["selection"])
        report(0.0, "running the filter")
        traced = library.traced(of)
        trace, task = traced.trace, traced.checkpoint.task
        settings = library.settings
        given, data = settings.checkpoints.get(of.filter), settings.data.get(of.data)
        path = str(given) if isinstance(given, Path) else None
        served = serving([path] if path else [], data, settings.seed)

        def link(index: int, step: int) -> str:
            return arguments["url"] + moment_link(task, of.filter, of.data, of.episode, step, str(of.faults))

        composed = compose(
            [trace],
            traced.checkpoint,
            title=wanted.title,
            chosen=[(0, step) for step in wanted.moments],
            every=wanted.every,
            link=link,
            opened=f"A link opens its moment in the dashboard while this runs: {served}.",
            commands=(
                trace_command(trace, "run.trace", path or "", data),
                report_command(["run.trace"], wanted.moments, wanted.every, wanted.title),
            ),
            progress=lambda share: report(0.1 + 0.4 * share, "measuring"),
        )
        folder = Path(arguments["folder"])
        folder.parent.mkdir(parents=True, exist_ok=True)
        chromium = browser() if wanted.pdf else None
        printing = None if chromium is None else lambda page, printed: print_page(chromium, page, printed)
        document = write_report(composed, folder, printing, lambda share: report(0.5 + 0.5 * share, "drawing"))
        return {"folder": str(folder), "files": document["files"]}
    finally:
        library.close()
