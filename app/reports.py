"""Reports over HTTP (docs/api.md): of the run that the page shows, made by a job, kept in the workspace."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fastapi import APIRouter, HTTPException, Request
from fastapi.responses import FileResponse, Response

from beliefscope.app.api import Asked
from beliefscope.app.commands.given import serving
from beliefscope.app.commands.report import trace_command
from beliefscope.app.jobs import Job, Jobs
from beliefscope.app.library import Library, Selection, Settings
from beliefscope.app.link import moment_link
from beliefscope.app.work import Report
from beliefscope.datasets.corrupt import Recipe
from beliefscope.recordings.report import compose, write_report

NAME = re.compile(r"[\w.+-]+-episode\d+-[0-9a-f]{8}")


def routes(library: Library, jobs: Jobs) -> APIRouter:
    """Every route under ``/api/reports``."""
    router = APIRouter()
    reports = library.settings.workspace / "reports"

    @router.post("/api/reports/{task}/{filter}/{episode}", status_code=202)
    def make(asked: Asked, request: Request) -> dict[str, Job]:
        url = str(request.base_url)
        key = repr((library.key(asked), asked.filter, asked.data, url))
        short = hashlib.sha256(key.encode()).hexdigest()[:8]
        name = f"{re.sub(r'[^A-Za-z0-9_.+-]', '-', f'{asked.task}-{asked.filter}')}-episode{asked.episode}-{short}"
        arguments = {
            "settings": library.settings.to_json(),
            "task": asked.task,
            "filter": asked.filter,
            "data": asked.data,
            "recipe": str(asked.recipe),
            "episode": asked.episode,
            "url": url,
            "folder": str(reports / name),
        }
        title = f"Report of {asked.filter}, {asked.task} episode {asked.episode}"
        title += f", {asked.recipe}" if asked.recipe else ""
        return {"job": jobs.submit("report", title, arguments, key, f"api/reports/{name}.html")}

    @router.get("/api/reports/{name}.html")
    def page(name: str) -> Response:
        path = reports / name / "report.html"
        if not NAME.fullmatch(name) or not path.is_file():
            raise HTTPException(404, f"Report {name!r} does not exist.")
        return FileResponse(path, media_type="text/html; charset=utf-8", filename=f"{name}.html")

    return router


def work(arguments: Mapping[str, Any], report: Report) -> dict[str, Any]:
    """The job of a report: its folder. What was traced before is read, not traced again."""
    library = Library(Settings.of_json(arguments["settings"]))
    try:
        recipe = Recipe.parse(arguments["recipe"])
        of = Selection(arguments["task"], arguments["filter"], arguments["episode"], recipe, arguments["data"])
        report(0.0, "running the filter")
        traced = library.traced(of)
        trace, task = traced.trace, traced.checkpoint.task
        settings = library.settings
        given, data = settings.checkpoints.get(of.filter), settings.data.get(of.data)
        path = str(given) if isinstance(given, Path) else None
        served = serving([path] if path else [], data, settings.seed)

        def link(index: int, step: int) -> str:
            return arguments["url"] + moment_link(task, of.filter, of.data, of.episode, step, str(recipe))

        composed = compose(
            [trace],
            traced.checkpoint,
            link=link,
            opened=f"A link opens its moment in the dashboard while this runs: {served}.",
            commands=(trace_command(trace, "run.trace", path or "", data), "beliefscope report run.trace -o report"),
            progress=lambda share: report(0.1 + 0.4 * share, "measuring"),
        )
        folder = Path(arguments["folder"])
        folder.parent.mkdir(parents=True, exist_ok=True)
        document = write_report(composed, folder, progress=lambda share: report(0.5 + 0.5 * share, "drawing"))
        return {"folder": str(folder), "files": document["files"]}
    finally:
        library.close()
