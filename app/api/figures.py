"""Route of the figure of a run's timeline."""

from collections.abc import Sequence
from concurrent.futures import Executor
from typing import Annotated, Literal

from fastapi import FastAPI, Query
from fastapi.responses import Response

from beliefscope.app.api.traces import IN_PROGRESS, RequestedRun, finished_run
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.inspect.figures.timeline import DEFAULT_CHARTS, View, timeline
from beliefscope.inspect.figures.timeline_figure import encoded_timeline

MEDIA_TYPES = {"svg": "image/svg+xml", "pdf": "application/pdf", "png": "image/png", "csv": "text/csv"}


def add_routes(app: FastAPI, store: TraceStore, drawing: Executor) -> None:
    """drawing: one thread, as in ``RecordingFolder``."""

    @app.get("/api/trace/{task}/{filter}/{episode}/timeline.{format}", response_class=Response, responses=IN_PROGRESS)
    def timeline_file(
        selection: RequestedRun,
        format: Literal["svg", "pdf", "png", "csv"],
        charts: Annotated[Sequence[str], Query(alias="chart")] = DEFAULT_CHARTS,
        component: str = "",
        weights: Literal["effective", "raw"] = "effective",
        window: str = "",
        time: Literal["steps", "seconds"] = "steps",
        group: str = "",
        against: str = "",
    ) -> Response:
        view = View(tuple(charts), component, weights == "raw", window, time == "seconds", group)
        other = finished_run(store, selection.comparison(against)).trace if against else None
        result = timeline(finished_run(store, selection).trace, view, other)
        content = drawing.submit(encoded_timeline, result, format).result()
        name = {"Content-Disposition": f'attachment; filename="{selection.file_stem}-timeline.{format}"'}
        return Response(content, media_type=MEDIA_TYPES[format], headers=name)
