"""Routes of the health check, the catalog and traces."""

from collections.abc import Callable
from typing import Annotated, Any, Literal

from fastapi import Depends, FastAPI, Query, Request
from fastapi.responses import Response

from beliefscope import __version__
from beliefscope.app.api.models import Component, LiveRun, Progress, Reply, TaskInfo
from beliefscope.app.protocol.errors import InProgress, NotFound
from beliefscope.app.protocol.etag import tagged
from beliefscope.app.protocol.messages import SceneLayer
from beliefscope.app.runs.examples import Example
from beliefscope.app.runs.selection import Selection
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.runs.traced_run import TracedRun
from beliefscope.app.views.registry import Views
from beliefscope.datasets import episode_list
from beliefscope.datasets.dataset import EpisodeSummary
from beliefscope.datasets.faults.injection import FaultInfo, Faults, fault_catalog
from beliefscope.inspect.maps.likelihood_map import Quantity
from beliefscope.inspect.traces.sensors import DisplayedSensor, displayed_sensors, sensor_pixels

TRACE_TIMEOUT = 0.25  # s that a request waits for a trace before it answers with the progress
IN_PROGRESS: dict[int | str, dict[str, Any]] = {202: {"model": Progress}}


class Health(Reply):
    """Health check. late: s that maps and scenes are overdue."""

    status: Literal["ok"]
    version: str
    late: float


class EpisodeList(Reply):
    """A part of the episodes of a data set that match a query. count: of all that match."""

    count: int
    episodes: list[EpisodeSummary]


class Catalog(Reply):
    """Everything the server can show.

    examples: none on a server with the user's filters, data sets or tasks. problems: one line per unusable file.
    """

    version: str
    read_only: bool
    examples: list[Example]
    faults: list[FaultInfo]
    tasks: list[TaskInfo]
    problems: list[str]


class Column(Reply):
    """A float32 array in the columns buffer; offset in bytes. channels: of readings and reported innovations (T, d)."""

    name: str
    shape: list[int]
    offset: int
    channels: list[Component] | None = None


class Failure(Reply):
    """The first reason for which a filter fails, and the steps at which the run restarts it at the true state."""

    failure: str
    restarts: list[int]


class TraceHeader(Reply):
    """Metadata of a trace.

    Attributes:
        first_counted: first step that metrics include, after the warm-up of the task.
        groups: names of the groups of covariates, in the order of the column ``groups`` (T, G).
        weight_width: 0 for a filter without weights. settings: of the run.
        nees_bounds: 95 % bounds of a consistent filter's NEES/n; None without a covariance.
        no_maps: why there are no likelihood maps, or None. missing_quantities: quantities without maps, and the
            reasons. sensors: drawn ones.
        no_diagnosis: why the filter has no diagnosis, or None. defects: errors of such a filter that show without one.
        failure: present if the filter fails at a step.
        data_warning: how the data differ from the checkpoint's training data, or None.
        scene: layers of its 3D scene. live: present while the trace is of a live run.
    """

    steps: int
    first_counted: int
    dt: float
    kind: str
    filter: str
    episode: int
    components: list[Component]
    modalities: list[str]
    groups: list[str]
    weight_width: int
    checkpoint_hash: str
    data_hash: str
    seed: int
    faults: str
    settings: dict[str, Any]
    nees_bounds: tuple[float, float] | None
    no_maps: str | None
    missing_quantities: dict[Quantity, str]
    sensors: list[DisplayedSensor]
    columns: list[Column]
    data_warning: str | None = None
    no_diagnosis: str | None = None
    defects: tuple[str, ...] = ()
    failure: Failure | None = None
    scene: list[SceneLayer]
    live: LiveRun | None = None


def _selection(task: str, filter: str, episode: int, faults: str = "", data: str = "") -> Selection:
    return Selection(task, filter, episode, Faults.parse(faults), data)


RequestedRun = Annotated[Selection, Depends(_selection)]
"""The run selected by path and query."""


def _comparison(request: RequestedRun, against: str = "") -> Selection:
    return request.comparison(against) if against else request


RequestedRunOrComparison = Annotated[Selection, Depends(_comparison)]
"""The run selected by path and query, or its comparison run if the query has ``against``."""


def add_routes(app: FastAPI, store: TraceStore, views: Views) -> None:
    """Add the routes. Handlers that block are plain functions, which FastAPI runs in threads."""

    @app.get("/healthz")
    async def health() -> Health:
        return Health(status="ok", version=__version__, late=round(views.overdue(), 1))

    @app.get("/api/catalog", response_model=Catalog)
    def catalog(request: Request, task: str = "", filter: Annotated[tuple[str, ...], Query()] = ()) -> dict[str, Any]:
        server = {"version": __version__, "read_only": request.app.state.read_only, "faults": fault_catalog()}
        return {**server, **store.catalog(task, filter)}

    @app.get("/api/episodes/{task}", response_model=EpisodeList)
    def episodes(
        task: str,
        data: str = "",
        query: str = "",
        first: Annotated[int, Query(ge=0)] = 0,
        limit: Annotated[int, Query(ge=1)] = episode_list.LISTED,
    ) -> dict[str, Any]:
        count, page = episode_list.find(store.dataset(task, data)[1], query, first, limit)
        return {"count": count, "episodes": page}

    @app.get(
        "/api/trace/{task}/{filter}/{episode}",
        response_model=TraceHeader,
        response_model_exclude_unset=True,
        responses=IN_PROGRESS,
    )
    def trace_header(selection: RequestedRunOrComparison) -> Any:
        return finished_run(store, selection).header | {"filter": selection.filter}

    @app.get("/api/trace/{task}/{filter}/{episode}/columns", response_class=Response, responses=IN_PROGRESS)
    def trace_columns(selection: RequestedRunOrComparison, request: Request) -> Response:
        run = finished_run(store, selection)
        return _immutable(request, run, "columns", lambda: run.columns[1])

    @app.get("/api/trace/{task}/{filter}/{episode}/images", response_class=Response, responses=IN_PROGRESS)
    def trace_images(selection: RequestedRunOrComparison, request: Request, sensor: str = "") -> Response:
        run = finished_run(store, selection)
        names = [displayed.name for displayed in displayed_sensors(run.trace)]
        name = sensor or next(iter(names), "")
        if name not in names:
            raise NotFound(f"Sensor {name!r} has no images. Available: {', '.join(names) or 'none'}.")
        pixels = sensor_pixels(run.trace, name)
        return _immutable(request, run, f"images {name}", pixels.tobytes)


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
