"""The timeline of a run: its charts, visible steps and marked steps, drawn by ``timeline_figure``, and as CSV."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.datasets.task import display_name
from beliefscope.inspect.figures.timeline_charts import Chart, chart_names, chart_of
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.measures import Mask
from beliefscope.inspect.trace import Trace

DEFAULT_CHARTS = ("weights", "estimate", "error")
WINDOW = r"(\d+(?:\.\d+)?)-(\d+(?:\.\d+)?)"


@dataclass(frozen=True)
class View:
    """What the timeline shows of a run.

    Attributes:
        charts: from top to bottom, as in ``timeline_charts.chart_names``.
        component: state component of the charts; the first one of the map if empty.
        beta: whether the weights are the fusion weights beta, the network's output, if the filter also has effective
            weights.
        window: first and last visible step, such as ``20-60``, which may have fractions; all steps if empty.
        seconds: whether the horizontal axis is the time in s instead of the step.
        group: of steps that are shaded, such as ``contact``; the first one of the task if empty.
    """

    charts: tuple[str, ...] = DEFAULT_CHARTS
    component: str = ""
    beta: bool = False
    window: str = ""
    seconds: bool = False
    group: str = ""

    def __post_init__(self) -> None:
        """Raises BadInput for a window of another form."""
        if self.window and re.fullmatch(WINDOW, self.window) is None:
            raise BadInput(f"window {self.window!r} is not FIRST-LAST, such as 20-60")


DEFAULT = View()


@dataclass(frozen=True)
class Timeline:
    """The charts of a run.

    Attributes:
        comparison: comparison run over the same episode, or None.
        charts: those with values. missing: title -> reason of the others.
        window: first and last visible step, which may have fractions.
        group: name of the shaded group of steps; empty for none.
    """

    trace: Trace
    comparison: Trace | None
    view: View
    charts: list[Chart]
    missing: dict[str, str]
    window: tuple[float, float]
    group: str

    @cached_property
    def bands(self) -> dict[str, Mask]:
        """Name -> mask (T,) of the marked steps: of the group, with a blackout, a fault or an intervention."""
        trace = self.trace
        groups = {self.group: measures.shaded_groups(trace)[self.group]} if self.group else {}
        bands = {**groups, "image blackout": measures.blackout(trace), "injected fault": measures.faulty(trace)}
        edits = () if self.comparison is None else self.comparison.settings.get("edits", ())
        steps = np.arange(len(trace))
        for edit in edits:
            before = bands.get("intervention", np.zeros(len(trace), dtype=bool))
            bands["intervention"] = before | (steps >= edit["from"]) & (steps < edit["to"])
        return {name: mask for name, mask in bands.items() if mask.any()}

    @cached_property
    def time(self) -> NDArray[np.float64]:
        """(T,) s since step 0."""
        time = self.trace.episode.time
        return np.asarray(np.arange(len(self.trace)) * self.trace.episode.dt if time is None else time, np.float64)

    def csv(self) -> str:
        """Rows: the visible steps. Columns: the lines with their units, and 1 for steps with a mark."""
        first, last = int(np.ceil(self.window[0])), int(np.floor(self.window[1]))
        columns: dict[str, Iterable[Any]] = {"step": np.arange(len(self.trace)), "time_s": self.time}
        for chart in self.charts:
            for line in chart.series:
                suffixes = {"": line.values, "sigma": line.sigma}
                names = (chart.title, line.name, "comparison" if line.comparison else "")
                columns |= {
                    _column_name((*names, suffix), chart.unit): values
                    for suffix, values in suffixes.items()
                    if values is not None
                }
        columns |= {_column_name((name,), ""): mask.astype(int) for name, mask in self.bands.items()}
        rows = zip(*(np.asarray(values)[first : last + 1] for values in columns.values()), strict=True)
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([_number(value) for value in row] for row in rows)
        return text.getvalue()


def timeline(trace: Trace, view: View = DEFAULT, comparison: Trace | None = None) -> Timeline:
    """The charts of a run with the visible steps.

    Raises:
        BadInput: the run has no such chart, component, group or steps, none of the charts has values, or the
            comparison run is over another episode.
    """
    if comparison is not None and (comparison.data_hash, len(comparison)) != (trace.data_hash, len(trace)):
        raise BadInput("the comparison run is over another episode")
    index = trace.task.index(view.component) if view.component else trace.task.map_indices[0]
    groups = list(measures.shaded_groups(trace))
    if view.group:
        check_name("group of steps", view.group, groups)
    available = dict.fromkeys(name for run in (trace, comparison) if run is not None for name in chart_names(run))
    charts: list[Chart] = []
    missing = {}
    for name in view.charts:
        check_name("chart", name, available)
        chart = chart_of(name, trace, index, view.beta)
        other = None if comparison is None else chart_of(name, comparison, index, view.beta)
        if isinstance(other, Chart) and comparison is not None:
            chart = _overlay(chart, other, comparison.settings.get("standalone"))
        if isinstance(chart, Chart) and chart.series:
            charts.append(chart)
        else:
            missing[name] = "it has no values" if isinstance(chart, Chart) else chart
    if not charts:
        raise BadInput(f"no chart has values: {'; '.join(f'{name}: {reason}' for name, reason in missing.items())}")
    group = view.group or next(iter(groups), "")
    return Timeline(trace, comparison, view, charts, missing, _visible(view.window, len(trace)), group)


def _overlay(chart: Chart | str, other: Chart, standalone: str | None) -> Chart:
    """The chart with the lines of the comparison run; standalone: the only modality of that run, if any."""
    lines = [
        replace(line, name=f"{display_name(standalone)} standalone", source=standalone)
        if standalone and line.source == "fused"
        else line
        for line in other.series
        if line.source != "truth"
    ]
    lines = [replace(line, sigma=None, comparison=True) for line in lines]
    if isinstance(chart, str):
        areas = any(line.stacked for line in lines)  # edges alone would leave the chart empty
        return replace(other, title=f"{other.title}, comparison", series=other.series if areas else lines)
    limits = chart.limits
    if limits and other.limits:
        limits = min(limits[0], other.limits[0]), max(limits[1], other.limits[1])
    kinds = [title.split(",")[0] for title in (chart.title, other.title)]
    title = chart.title if kinds[0] == kinds[1] else f"{kinds[0]} / {kinds[1].lower()}"
    return replace(chart, title=title, limits=limits, series=[*chart.series, *lines])


def _column_name(parts: Sequence[str], unit: str) -> str:
    """Name of a column with its unit, such as ``position_error_fused_cm``."""
    words = "_".join(re.sub(r"[^a-z0-9]+", "_", part.lower()).strip("_") for part in parts if part)
    return f"{words}_{unit}" if unit else words


def _number(value: Any) -> str:
    """An integer, or a number in single precision; empty for a missing one."""
    if isinstance(value, np.integer):
        return str(value)
    return f"{value:z.7g}" if np.isfinite(value) else ""


def _visible(window: str, steps: int) -> tuple[float, float]:
    """First and last visible step. Raises BadInput if the run has none of them."""
    last = float(max(steps - 1, 1))
    match = re.fullmatch(WINDOW, window or f"0-{last}")
    assert match is not None
    first, end = float(match[1]), min(float(match[2]), last)
    if first == end:
        raise BadInput(f"window {window!r} has one step: a line needs two")
    if first > end:
        raise BadInput(f"window {window!r} has no steps: the run has steps 0 to {steps - 1}")
    return first, end
