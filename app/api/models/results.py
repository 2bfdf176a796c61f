"""Models of JSON responses: diagnostics, comparisons and failures."""

from typing import Literal

from beliefscope.app.api.models.catalog import Number, Reply, fields_of
from beliefscope.inspect.diagnostics import views
from beliefscope.inspect.diagnostics.base import Entry
from beliefscope.inspect.failures import by_episode
from beliefscope.inspect.failures.events import Event, PhaseStatistics
from beliefscope.inspect.slices.report import ErrorSlice
from beliefscope.inspect.slices.search import Condition


@fields_of(views.Curve)
class Curve(Reply):
    """A quantity over the steps of a trace."""


@fields_of(views.Line)
class Line(Reply):
    """A line of a plot."""


@fields_of(views.Plot)
class Plot(Reply):
    """A plot whose x axis is not time. diagonal: draw y = x. names: labels of x = 0, 1, ..."""

    lines: list[Line]


@fields_of(views.ImagePanel)
class PixelMap(Reply):
    """A value per pixel of a camera image."""

    values: list[list[Number]]


class ResultViews(Reply):
    """Tables, curves and figures of a result, in cm and degrees."""

    verdict: str
    tables: list[views.Table]
    curves: list[Curve]
    bands: dict[str, list[bool]]
    plots: list[Plot]
    images: list[PixelMap]


class DiagnosticResult(ResultViews):
    """Result of a diagnostic over one or more trajectories."""

    trajectories: int


class Comparison(ResultViews):
    """Comparison of two runs. edit: description of the intervention, or None."""

    names: tuple[str, str]
    edit: str | None


class DiagnosticOption(Reply):
    """An option of a diagnostic; an empty default means none."""

    name: str
    meaning: str
    default: str


@fields_of(Entry, "name", "title", "question", "slow")
class DiagnosticInfo(Reply):
    """A diagnostic. slow: computed by a job."""

    options: list[DiagnosticOption]


class TraceDiagnosticInfo(DiagnosticInfo):
    """A diagnostic of one trace. why_not: why it is not available for this trace, or None."""

    why_not: str | None


@fields_of(PhaseStatistics)
class PhaseInfo(Reply):
    """The steps of a phase compared with all others."""

    over_represented: bool


@fields_of(
    Event, "episode", "step", "first", "last", "time", "first_time", "last_time", "phase", "other_phases", "error"
)
class FailureEvent(Reply):
    """A failure event. error: per layer, m. link: the page's address that opens it. Times: s, or None."""

    value: Number
    nees: Number
    ess: Number
    effective_weights: list[Number] | None
    link: str


@fields_of(Condition)
class SliceCondition(Reply):
    """Values of a covariate: ``low < value <= high`` in its SI unit, either may be None; or a category."""


@fields_of(ErrorSlice)
class FailureSlice(Reply):
    """A data slice with a larger score. worst: episode and step of the largest one."""

    conditions: list[SliceCondition]


class FailureSlices(Reply):
    """Data slices in which a score is larger. summary: their number and the searched data, or why there are none."""

    summary: str
    rows: list[FailureSlice]


class FailureScore(Reply):
    """Failures ranked by one score. why_not: why the filter does not have it; the other fields are absent then."""

    name: str
    title: str
    unit: str
    shown: str
    scale: float
    why_not: str | None
    verdict: str | None = None
    threshold: Number = None
    total: int | None = None
    counts: dict[str, int] | None = None
    phases: list[PhaseInfo] | None = None
    events: list[FailureEvent] | None = None
    slices: FailureSlices | None = None


@fields_of(by_episode.EpisodeErrors)
class EpisodeErrors(Reply):
    """Position errors of one episode."""


class Failures(Reply):
    """Failures of a filter over a data set."""

    task: str
    filter: str
    data: str
    faults: str
    among: Literal["held-out", "all"]
    particles: int | None
    steps: int
    layers: list[str]
    scores: list[FailureScore]
    episodes: list[EpisodeErrors]
