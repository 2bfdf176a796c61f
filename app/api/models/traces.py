"""Models of JSON responses: traces, live runs and views."""

from typing import Any, Literal

from beliefscope.app.api.models.catalog import Component, Reply, TaskInfo
from beliefscope.app.protocol.messages import SceneLayer
from beliefscope.inspect.maps.likelihood_map import Quantity
from beliefscope.inspect.traces.sensors import DisplayedSensor


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


class Column(Reply):
    """A float32 array in the columns buffer; offset in bytes."""

    name: str
    shape: list[int]
    offset: int


class TraceHeader(Reply):
    """Metadata of a trace.

    Attributes:
        groups: names of the groups of covariates, in the order of the column ``groups`` (T, G).
        weight_width: 0 for a filter without weights. settings: of the run.
        nees_bounds: 95 % bounds of a consistent filter's NEES; None without a covariance.
        no_maps: why there are no likelihood maps, or None. missing_quantities: quantities without maps, and the
            reasons. sensors: drawn ones.
        no_diagnosis: why the filter has no diagnosis, or None.
        data_warning: how the data differ from the checkpoint's training data, or None.
        scene: layers of its 3D scene. live: present while the trace is of a live run.
    """

    steps: int
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
    scene: list[SceneLayer]
    live: LiveRun | None = None


class ViewAddresses(Reply):
    """Addresses of an open view."""

    view: str
    scene: str
    socket: str
