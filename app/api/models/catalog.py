"""Models of JSON responses: shared ones, the health check and the catalog.

The page's TypeScript types are generated from all models in this package. Large responses are sent without validation;
the tests validate them (``tests/app/conftest.py``).
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from beliefscope.app.jobs.queue import Job
from beliefscope.datasets.dataset import EpisodeSummary

Number = float | None
"""None if not finite or not available."""


class Reply(BaseModel):
    """Base of all response models; unknown fields are errors."""

    model_config = ConfigDict(extra="forbid")


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


class Component(Reply):
    """A component of the state."""

    name: str
    unit: str


class MapArea(Reply):
    """Components on the axes of the likelihood maps, and half the side length (m)."""

    x: str
    y: str
    half_width: float


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
    """A data set in the catalog. first: the episode to open first."""

    name: str
    first: int
    episodes: list[EpisodeSummary]


class TaskInfo(Reply):
    """A task in the catalog, its filters and data sets; the first of each is the default."""

    name: str
    components: list[Component]
    modalities: list[str]
    dt: float
    map: MapArea
    fault_presets: list[FaultPreset]
    filters: list[FilterInfo]
    data: list[DataInfo]


class FaultParameter(Reply):
    """A parameter of a fault."""

    name: str
    default: Any
    unit: str
    meaning: str


class FaultInfo(Reply):
    """A kind of fault."""

    fault: str
    meaning: str
    parameters: list[FaultParameter]


class Catalog(Reply):
    """Everything the server can show. problems: one line per file that cannot be used."""

    version: str
    read_only: bool
    faults: list[FaultInfo]
    tasks: list[TaskInfo]
    problems: list[str]
