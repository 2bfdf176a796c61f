"""Base of the models of JSON responses, and models shared by several routes; others stand beside their routes.

The page's TypeScript types are generated from all of them. Large responses are sent without validation; the tests
validate them (``tests/app/conftest.py``). Dataclasses of other folders are used as they are if they have only plain
fields; models of those with arrays or numbers that may not be finite are derived, by ``Encoded`` or, if they have other
fields too, by ``fields_of``.
"""

import dataclasses
from collections.abc import Callable
from functools import cache
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, create_model
from pydantic_core import CoreSchema

from beliefscope.app.jobs.queue import Job
from beliefscope.datasets.dataset import EpisodeSummary
from beliefscope.inspect.diagnostics import views

Number = float | None
"""None if not finite or not available."""


class Reply(BaseModel):
    """Base of all response models; unknown fields are errors."""

    model_config = ConfigDict(extra="forbid")


class RequestBody(BaseModel):
    """Base of all request bodies; unknown fields and other types are errors."""

    model_config = ConfigDict(extra="forbid", strict=True)


R = TypeVar("R", bound=Reply)
T = TypeVar("T")


def fields_of(source: type, *names: str) -> Callable[[type[R]], type[R]]:
    """Class decorator that adds fields of a dataclass, all or the named ones, as ``as_json`` encodes them.

    Arrays become lists of one dimension; declare the field in the class for other ones.
    """

    def add(model: type[R]) -> type[R]:
        hints = get_type_hints(source)
        wanted = names or [field.name for field in dataclasses.fields(source)]
        fields: Any = {name: (_json_type(hints[name]), ...) for name in wanted if name not in model.model_fields}
        return create_model(
            model.__name__, __base__=model, __doc__=model.__doc__, __module__=model.__module__, **fields
        )

    return add


def _json_type(hint: Any) -> Any:
    """The type of a field's JSON value: None for non-finite numbers, lists for arrays, models for dataclasses."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is np.ndarray:
        (scalar,) = get_args(arguments[1])
        return list[bool] if scalar is np.bool_ else list[Number]
    if origin is tuple and dataclasses.is_dataclass(arguments[0]):
        return list[_model(arguments[0])]  # type: ignore[arg-type, misc]
    return Number if hint is float else hint


@cache
def _model(source: type) -> type[Reply]:
    """The model of a dataclass as ``as_json`` encodes it."""
    return fields_of(source)(create_model(source.__name__, __base__=Reply, __doc__=source.__doc__))


class _ModelOf:
    """Annotation that replaces a dataclass by its model."""

    def __get_pydantic_core_schema__(self, source: type, handler: GetCoreSchemaHandler) -> CoreSchema:
        return handler.generate_schema(_model(source))


Encoded = Annotated[T, _ModelOf()]
"""``Encoded[D]``: a dataclass D as ``as_json`` encodes it."""


class Error(Reply):
    """Body of every response with a 4xx or 5xx status."""

    error: str


class Progress(Reply):
    """Body of a 202 response while a trace is computed: 0..1."""

    progress: float


class JobReply(Reply):
    """Body of a 202 response: the job that computes the result; None if it has not been requested yet."""

    job: Job | None


class MapArea(Reply):
    """Components on the axes of the likelihood maps, one or two, and half the extent (in the unit of the first)."""

    components: list[str]
    half_width: float


class MainError(Reply):
    """The error that runs are summarised by. indices: of the components; scale: factor to the unit for display."""

    name: str
    key: str
    unit: str
    scale: float
    indices: list[int]


class FilterInfo(Reply):
    """A filter in the catalog. training, metrics: its training record."""

    name: str
    kind: str
    checkpoint_hash: str
    training: dict[str, Any]
    metrics: dict[str, Any]


class FaultPreset(Reply):
    """A named fault injection. stored: as runs and links name it, without default values."""

    name: str
    faults: str
    stored: str


class DataInfo(Reply):
    """A data set in the catalog. first, first_step: the episode and step to open first.

    episodes: all ``count`` of them, or some around the first one; ``EpisodeList`` has the others.
    """

    name: str
    first: int
    first_step: int
    count: int
    episodes: list[EpisodeSummary]


class Component(Reply):
    """A state component. Values times ``scale`` are in ``display_unit``."""

    name: str
    unit: str
    display_unit: str
    scale: float


class TaskInfo(Reply):
    """A task in the catalog, its filters and data sets; the first of each is the default.

    simulated: whether more episodes can be collected.
    """

    name: str
    components: list[Component]
    modalities: list[str]
    dt: float
    simulated: bool
    map: MapArea
    main: MainError
    fault_presets: list[FaultPreset]
    filters: list[FilterInfo]
    data: list[DataInfo]


class LiveState(Reply):
    """State of a live run. message: explanation of an abnormal state, or empty."""

    name: str
    state: Literal["running", "ended", "died", "damaged"]
    message: str


class LiveRun(LiveState):
    """A live run. expected: number of steps, if announced. started: ISO 8601."""

    data: str
    task: str
    episode: int
    faults: str
    steps: int
    expected: int | None
    started: str


class ListedLiveRun(LiveRun):
    """A live run in the list. filter: its name in the catalog. available: whether its checkpoint is available."""

    filter: str
    available: bool
    kind: str


class LiveList(Reply):
    """Live runs, newest first, and their tasks; an unreadable file has only its state."""

    runs: list[ListedLiveRun | LiveState]
    tasks: list[TaskInfo]


class FilterName(Reply):
    """Name of a filter in the catalog."""

    filter: str


@fields_of(views.ImagePanel)
class PixelMap(Reply):
    """A value per pixel of a camera image."""

    values: list[list[Number]]


class ResultViews(Reply):
    """Tables, curves and figures of a result, in cm and degrees."""

    verdict: str
    tables: list[views.Table]
    curves: list[Encoded[views.Curve]]
    bands: dict[str, list[bool]]
    plots: list[Encoded[views.Plot]]
    images: list[PixelMap]


class DeletedId(Reply):
    """Id that restores a deleted file."""

    deleted: str


class Freed(Reply):
    """Size of permanently deleted files."""

    freed: int
