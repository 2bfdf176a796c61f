"""Models of JSON responses: diagnostics, comparisons and failures."""

from __future__ import annotations

from typing import Literal

from beliefscope.app.api.models.catalog import Number, Reply


class Table(Reply):
    """A table; column names include the unit."""

    title: str
    columns: list[str]
    rows: list[list[str | int | float | None]]


class Curve(Reply):
    """A quantity over the steps of a trace."""

    name: str
    values: list[Number]
    chart: str
    unit: str
    layer: str
    bounds: tuple[float, float] | None


class Line(Reply):
    """A line of a plot."""

    name: str
    x: list[Number]
    y: list[Number]
    layer: str


class Plot(Reply):
    """A plot whose x axis is not time. diagonal: draw y = x. names: labels of x = 0, 1, ..."""

    title: str
    x_label: str
    y_label: str
    lines: list[Line]
    kind: Literal["line", "points", "bars"]
    diagonal: bool
    names: list[str]


class PixelMap(Reply):
    """A value per pixel of a camera image."""

    title: str
    values: list[list[Number]]
    unit: str
    signed: bool


class ResultViews(Reply):
    """Tables, curves and figures of a result, in cm and degrees."""

    verdict: str
    tables: list[Table]
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


class DiagnosticInfo(Reply):
    """A diagnostic. slow: computed by a job."""

    name: str
    title: str
    question: str
    slow: bool
    options: list[DiagnosticOption]


class TraceDiagnosticInfo(DiagnosticInfo):
    """A diagnostic of one trace. why_not: why it is not available for this trace, or None."""

    why_not: str | None


class PhaseInfo(Reply):
    """The steps of a phase compared with all others (``inspect.failures.events.PhaseStatistics``)."""

    name: str
    steps: int
    events: int
    share: Number
    event_share: Number
    lift: Number
    p_value: Number
    inside: Number
    outside: Number
    over_represented: bool


class FailureEvent(Reply):
    """A failure event. error: per layer, m. link: the page's address that opens it."""

    episode: int
    step: int
    first: int
    last: int
    value: Number
    phase: str
    other_phases: list[str]
    error: list[Number]
    nees: Number
    ess: Number
    effective_weights: list[Number] | None
    link: str


class FailureScore(Reply):
    """Failures ranked by one score. why_not: why the filter does not have it; the other fields are absent then."""

    name: str
    title: str
    unit: str
    why_not: str | None
    verdict: str | None = None
    threshold: Number = None
    total: int | None = None
    counts: dict[str, int] | None = None
    phases: list[PhaseInfo] | None = None
    events: list[FailureEvent] | None = None


class EpisodeErrors(Reply):
    """Position errors of one episode (``inspect.failures.by_episode``)."""

    index: int
    steps: int
    rmse: Number
    worst: Number
    worst_step: int | None
    error: list[Number]
    contact: list[bool]


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
