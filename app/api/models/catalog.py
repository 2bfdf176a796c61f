"""Base of the models of JSON responses, and models shared by several routes.

The page's TypeScript types are generated from all models in this package. Large responses are sent without validation;
the tests validate them (``tests/app/conftest.py``). Dataclasses of other folders are used as they are if they have only
plain fields; models of those with arrays are derived by ``fields_of``.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import BaseModel, ConfigDict, create_model

from beliefscope.app.jobs.queue import Job
from beliefscope.app.runs.examples import Example
from beliefscope.datasets.dataset import EpisodeSummary
from beliefscope.datasets.faults.injection import FaultInfo

Number = float | None
"""None if not finite or not available."""


class Reply(BaseModel):
    """Base of all response models; unknown fields are errors."""

    model_config = ConfigDict(extra="forbid")


class RequestBody(BaseModel):
    """Base of all request bodies; unknown fields and other types are errors."""

    model_config = ConfigDict(extra="forbid", strict=True)


R = TypeVar("R", bound=Reply)


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
    """The type of a field's JSON value: None for non-finite numbers, lists for arrays."""
    if get_origin(hint) is np.ndarray:
        (scalar,) = get_args(get_args(hint)[1])
        return list[bool] if scalar is np.bool_ else list[Number]
    return Number if hint is float else hint


class Error(Reply):
    """Body of every response with a 4xx or 5xx status."""

    error: str


class Progress(Reply):
    """Body of a 202 response while a trace is computed: 0..1."""

    progress: float


class JobReply(Reply):
    """Body of a 202 response: the job that computes the result; None if it has not been requested yet."""

    job: Job | None


class Health(Reply):
    """Health check. late: s that maps and scenes are overdue."""

    status: Literal["ok"]
    version: str
    late: float


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
    """A named fault injection."""

    name: str
    faults: str


class DataInfo(Reply):
    """A data set in the catalog. first, first_step: the episode and step to open first.

    episodes: all ``count`` of them, or some around the first one; ``EpisodeList`` has the others.
    """

    name: str
    first: int
    first_step: int
    count: int
    episodes: list[EpisodeSummary]


class EpisodeList(Reply):
    """A part of the episodes of a data set that match a query. count: of all that match."""

    count: int
    episodes: list[EpisodeSummary]


class Component(Reply):
    """A state component. Values times ``scale`` are in the unit ``shown``."""

    name: str
    unit: str
    shown: str
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
