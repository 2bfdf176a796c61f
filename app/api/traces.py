"""Routes of the health check, the catalog and traces."""

from collections.abc import Callable
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import Response

from beliefscope import __version__
from beliefscope.app.api.models.catalog import Catalog, EpisodeList, Health, Progress
from beliefscope.app.api.models.traces import TraceHeader
from beliefscope.app.protocol.errors import InProgress, NotFound
from beliefscope.app.protocol.etag import tagged
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.runs.traced_run import TracedRun
from beliefscope.app.views.registry import Views
from beliefscope.datasets import episode_list
from beliefscope.datasets.faults.injection import Faults, fault_catalog
from beliefscope.inspect.traces.sensors import displayed_sensors, sensor_pixels

TRACE_TIMEOUT = 0.25  # s that a request waits for a trace before it answers with the progress
IN_PROGRESS: dict[int | str, dict[str, Any]] = {202: {"model": Progress}}


def _selection(task: str, filter: str, episode: int, faults: str = "", data: str = "") -> Selection:
    return Selection(task, filter, episode, Faults.parse(faults), data)


RequestedRun = Annotated[Selection, Depends(_selection)]
"""The run selected by path and query."""


def _comparison(request: RequestedRun, against: str = "") -> Selection:
    return request.comparison(against) if against else request


RequestedRunOrComparison = Annotated[Selection, Depends(_comparison)]
"""The run selected by path and query, or its comparison run if the query has ``against``."""


def routes(store: TraceStore, views: Views) -> APIRouter:
    """Create the router. Handlers that block are plain functions, which FastAPI runs in threads."""
    router = APIRouter()

    @router.get("/healthz")
    async def health() -> Health:
        return Health(status="ok", version=__version__, late=round(views.overdue(), 1))

    @router.get("/api/catalog", response_model=Catalog)
    def catalog(request: Request, task: str = "", filter: Annotated[tuple[str, ...], Query()] = ()) -> dict[str, Any]:
        server = {"version": __version__, "read_only": request.app.state.read_only, "faults": fault_catalog()}
        return {**server, **store.catalog(task, filter)}

    @router.get("/api/episodes/{task}", response_model=EpisodeList)
    def episodes(
        task: str,
        data: str = "",
        query: str = "",
        first: Annotated[int, Query(ge=0)] = 0,
        limit: Annotated[int, Query(ge=1)] = episode_list.LISTED,
    ) -> dict[str, Any]:
        count, found = episode_list.find(store.dataset(task, data)[1], query, first, limit)
        return {"count": count, "episodes": found}

    @router.get(
        "/api/trace/{task}/{filter}/{episode}",
        response_model=TraceHeader,
        response_model_exclude_unset=True,
        responses=IN_PROGRESS,
    )
    def trace_header(selection: RequestedRunOrComparison) -> Any:
        return finished_run(store, selection).header | {"filter": selection.filter}

    @router.get("/api/trace/{task}/{filter}/{episode}/columns", response_class=Response, responses=IN_PROGRESS)
    def trace_columns(selection: RequestedRunOrComparison, request: Request) -> Response:
        run = finished_run(store, selection)
        return _immutable(request, run, "columns", lambda: run.columns[1])

    @router.get("/api/trace/{task}/{filter}/{episode}/images", response_class=Response, responses=IN_PROGRESS)
    def trace_images(selection: RequestedRunOrComparison, request: Request, sensor: str = "") -> Response:
        run = finished_run(store, selection)
        names = [displayed.name for displayed in displayed_sensors(run.trace)]
        name = sensor or next(iter(names), "")
        if name not in names:
            raise NotFound(f"Sensor {name!r} has no images. Available: {', '.join(names) or 'none'}.")
        pixels = sensor_pixels(run.trace, name)
        return _immutable(request, run, f"images {name}", pixels.tobytes)

    return router


def finished_run(store: TraceStore, selection: Selection) -> TracedRun:
    """The run. Raises InProgress if it is not finished within a short time.

    Requests do not wait until the end: they would occupy the worker threads.
    """
    run = store.request(selection)
    if not run.ready(TRACE_TIMEOUT):
        raise InProgress(run.progress)
    return run


def _immutable(request: Request, run: TracedRun, part: str, content: Callable[[], bytes]) -> Response:
    """Part of a trace; the ETag is the key, which covers everything the trace depends on."""
    return tagged(request, f"{run.key[:24]}-{part}", content, "application/octet-stream")
