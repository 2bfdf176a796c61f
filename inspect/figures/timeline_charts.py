"""Charts of the timeline, as the page shows them (app/page/timeline/tracks.js): their lines in units for display."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.task import Component, display_name
from beliefscope.datasets.text import capitalised
from beliefscope.filters.evaluate import nees_bounds
from beliefscope.inspect.diagnostics import weight_audit
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.statistics.channels import innovation_channels, reading_channels, residual_channels
from beliefscope.inspect.statistics.innovations import virtual_innovations
from beliefscope.inspect.trace import Trace

Array = NDArray[np.floating[Any]]

SHARE_TOLERANCE = 1e-3
"""Largest deviation of the sum of stacked weights from one."""


@dataclass(frozen=True)
class Series:
    """A line of a chart.

    Attributes:
        name: in legends.
        source: ``truth``, ``fused`` or a modality, or the number of a channel, for its colour.
        values: (T,) in the unit of the chart; NaN where there are none.
        sigma: (T,) predicted standard deviation of the values, or of their distance from zero if ``around_zero``.
        stacked: whether it is an area on those before it.
        comparison: whether it belongs to the comparison run.
    """

    name: str
    source: str | int
    values: Array
    sigma: Array | None = None
    around_zero: bool = False
    stacked: bool = False
    comparison: bool = False


@dataclass(frozen=True)
class Chart:
    """A chart of the timeline.

    Attributes:
        unit: of its values, for display; empty for none.
        limits: of the y axis; None to fit the visible values, from zero if ``from_zero``.
        bounds: interval that is expected to contain the values, of a chart with a logarithmic axis.
    """

    title: str
    unit: str
    series: list[Series]
    limits: tuple[float, float] | None = None
    from_zero: bool = False
    bounds: tuple[float, float] | None = None


def chart_names(trace: Trace) -> list[str]:
    """Names of the charts: those of every run, the filter's own scalars, and the channels of its sensors."""
    extra = [f"extra/{name}" for name in trace.extra]
    return [*CHARTS, *extra, *reading_channels(trace), *residual_channels(trace), *_innovation_columns(trace)]


def value_range(chart: Chart, first: int, last: int) -> tuple[float, float]:
    """Range of the y axis: that of the visible truth and fused estimate, and of most values of the modalities."""
    if chart.limits:
        return chart.limits
    visible = [_extremes(line, slice(first, last + 1)) for line in chart.series]
    values = np.array([value for pair in visible for value in pair if np.isfinite(value)])
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    if chart.bounds:
        least, most = chart.bounds
        return min(max(low, 0.1 * least), 0.5 * least), max(1.3 * high, 2.0 * most)
    low = 0.0 if chart.from_zero else low
    low, high = (low, high) if high > low else (low - 1.0, low + 1.0)
    margin = 0.06 * (high - low)
    return 0.0 if chart.from_zero else low - margin, high + margin


def _extremes(line: Series, steps: slice) -> tuple[float, float]:
    values = line.values[steps].astype(np.float64)
    if isinstance(line.source, int) or line.source in ("truth", "fused"):
        if line.sigma is not None:
            width = 2.0 * line.sigma[steps]
            centre = np.zeros_like(values) if line.around_zero else values
            values = np.concatenate([values, centre - width, centre + width])
        shares = (0.0, 1.0)
    else:
        shares = (0.02, 0.98)
    values = values[np.isfinite(values)]
    return tuple(np.quantile(values, shares)) if len(values) else (np.nan, np.nan)


def chart_of(name: str, trace: Trace, component: int, beta: bool = False) -> Chart | str:
    """A chart of a state component, or the reason why the run has no values for it.

    beta: whether the weights are the fusion weights beta, the network's output, if the filter also has effective
    weights.
    """
    if name not in chart_names(trace):
        return "the run does not have it"
    if name in CHARTS:
        return CHARTS[name](trace, component, beta)
    if name.startswith("extra/"):
        title = display_name(name.removeprefix("extra/"))
        return Chart(title, "", _lines([("fused", trace.extra[name.removeprefix("extra/")], None)], trace))
    if name.startswith("innovation/"):
        return _reported_innovation(trace, [name])
    kind, _, sensor = name.partition("/")
    values, channels = (residual_channels if kind == "residual" else reading_channels)(trace)[name]
    quantity = "minus truth" if kind == "residual" else "readings"
    title = "Controls" if sensor == "control" else f"{capitalised(display_name(sensor))} {quantity}"
    own_names = [channel.name.removeprefix(f"{sensor} ") for channel in channels]
    return _channel_chart(title, list(zip(own_names, channels, values.T, [None] * len(channels), strict=True)))


def _weights(trace: Trace, component: int, beta: bool) -> Chart | str:
    is_beta = trace.weights is not None and (beta or trace.effective_weights is None)
    weights = trace.weights if is_beta else trace.effective_weights
    if weights is None:
        return weight_audit.why_not(trace) or "the filter has no weights"
    by_component = weights.shape[-1] > 1
    values = weights[..., component if by_component else 0]
    stacked = values.shape[1] > 1 and _are_shares(values)
    series = _lines([(m, values[:, k], None) for k, m in enumerate(trace.modalities)], trace, of_modalities=True)
    title = "Fusion weight beta" if is_beta else "Effective weight"
    highest = max(1.0, float(np.nanmax(values, initial=1.0)))
    return Chart(
        f"{title}, {trace.task.components[component].label}" if by_component else title,
        "",
        [replace(line, stacked=stacked) for line in series],
        (0.0, 1.0) if stacked else (-0.04 * highest, 1.06 * highest),
    )


def _are_shares(weights: Array) -> bool:
    """Whether weights (T, K) are shares of one at every step that has values."""
    known = weights[np.isfinite(weights).any(-1)]
    return bool((np.abs(known.sum(-1) - 1.0) < SHARE_TOLERANCE).all() and (known > -SHARE_TOLERANCE).all())


def _estimate(trace: Trace, component: int, beta: bool) -> Chart | str:
    unit, factor = trace.task.components[component].conversion
    means = factor * trace.task.near(measures.means(trace), trace.episode.states[:, None])[..., component]
    truth = Series("truth", "truth", factor * trace.episode.states[:, component])
    return Chart(
        capitalised(trace.task.components[component].label), unit, [truth, *_estimates(trace, means, component)]
    )


def _error(trace: Trace, component: int, beta: bool) -> Chart | str:
    task = trace.task
    if not np.isfinite(trace.episode.states[:, component]).any():
        return measures.UNKNOWN_TRUTH
    if component in task.main_error.indices:
        title, (unit, factor), values = task.main_error.title, task.main_error.conversion, measures.main_error(trace)
    else:
        title, (unit, factor) = capitalised(task.components[component].label), task.components[component].conversion
        values = np.abs(measures.errors(trace)[..., component])
    return Chart(f"{title} error", unit, _sources(trace, factor * values), from_zero=True)


def _signed_error(trace: Trace, component: int, beta: bool) -> Chart | str:
    if not np.isfinite(trace.episode.states[:, component]).any():
        return measures.UNKNOWN_TRUTH
    unit, factor = trace.task.components[component].conversion
    truth = Series("truth", "truth", np.zeros(len(trace)))
    estimates = _estimates(trace, factor * measures.errors(trace)[..., component], component)
    return Chart(f"Signed error, {trace.task.components[component].label}", unit, [truth, *estimates])


def _nees(trace: Trace, component: int, beta: bool) -> Chart | str:
    series = _sources(trace, measures.nees(trace)) if trace.has_covariance else []
    if not series:
        reason = measures.no_covariance(trace)
        return measures.UNKNOWN_TRUTH if reason is None else f"the filter {reason}"
    return Chart("NEES/n", "", series, bounds=nees_bounds(len(trace.task.components), 1))


def _innovation(trace: Trace, component: int, beta: bool) -> Chart | str:
    if columns := _innovation_columns(trace):
        return _reported_innovation(trace, columns)
    if (pair := virtual_innovations(trace)) is None:
        return "the filter reports no predictions and measurements"
    unit, factor = trace.task.components[component].conversion
    values, sigma = (factor * part[..., component] for part in (pair[0], measures.deviations(pair[1])))
    lines = [(m, values[:, k], sigma[:, k]) for k, m in enumerate(trace.modalities)]
    series = [replace(line, around_zero=True) for line in _lines(lines, trace, of_modalities=True)]
    return Chart(f"Innovation, {trace.task.components[component].label}", unit, series)


def _particles(trace: Trace, component: int, beta: bool) -> Chart | str:
    size, count = trace.effective_sample_size, trace.particle_count
    if size is None or count is None:
        return "the filter has no particles"
    return Chart(
        f"Effective sample size of {count} particles", "", _lines([("fused", size, None)], trace), (0.0, 1.04 * count)
    )


CHARTS: dict[str, Callable[[Trace, int, bool], Chart | str]] = {
    "weights": _weights,
    "estimate": _estimate,
    "error": _error,
    "signed": _signed_error,
    "nees": _nees,
    "innovation": _innovation,
    "particles": _particles,
}
"""Charts of every run."""


def _innovation_columns(trace: Trace) -> list[str]:
    return [name for name in innovation_channels(trace) if name.startswith("innovation/")]


def _reported_innovation(trace: Trace, columns: Sequence[str]) -> Chart | str:
    """The innovation of modalities in the space of their measurements, a line for each channel with values."""
    reported = innovation_channels(trace)
    lines = []
    for column in columns:
        modality = column.removeprefix("innovation/")
        (values, channels), (sigma, _) = reported[column], reported[f"innovation_sigma/{modality}"]
        for i, channel in enumerate(channels):
            if np.isfinite(values[:, i]).any():
                name = f"{modality} {channel.name}" if channel.name.startswith("channel ") else channel.name
                lines.append((name, channel, values[:, i], _held(sigma[:, i])))
    only = f", {display_name(columns[0].removeprefix('innovation/'))}" if len(columns) == 1 else ""
    return _channel_chart(f"Innovation{only}", lines)


def _channel_chart(title: str, lines: Sequence[tuple[str, Component, Array, Array | None]]) -> Chart | str:
    """A chart of channels, given by name, channel, values (T,) and standard deviations around zero (T,)."""
    if not lines:
        return "there are no readings"
    units = {channel.conversion[0] for _, channel, _, _ in lines}
    common = units.pop() if len(units) == 1 else ""
    series = []
    for number, (name, channel, values, sigma) in enumerate(lines):
        unit, factor = channel.conversion
        label = display_name(f"{name} ({unit})" if unit and unit != common else name)
        scaled = None if sigma is None else factor * sigma
        series.append(Series(label, number, factor * values, scaled, around_zero=sigma is not None))
    return Chart(title, common, series)


def _held(values: Array) -> Array:
    """Values (T,) with the last finite one in place of missing ones; NaN before the first one."""
    known = np.isfinite(values)
    latest = np.maximum.accumulate(np.where(known, np.arange(len(values)), -1))
    return np.where(latest >= 0, values[latest], np.nan)


def _estimates(trace: Trace, values: Array, component: int) -> list[Series]:
    """Lines of the estimates (T, L) with their standard deviations."""
    if not trace.has_covariance:
        return _sources(trace, values)
    factor = trace.task.components[component].conversion[1]
    covariance = np.concatenate([trace.modality_covariance, trace.estimate_covariance[:, None]], axis=1)
    return _sources(trace, values, factor * measures.deviations(covariance)[..., component])


def _sources(trace: Trace, values: Array, sigma: Array | None = None) -> list[Series]:
    """Lines of the quantities (T, L) of the single-modality updates, if any, and of the fused estimate."""
    layers = measures.layers(trace)
    shown = (*(trace.modalities_with_posterior if len(trace.modalities) > 1 else ()), "fused")
    columns = [(name, layers.index(name)) for name in shown]
    return _lines([(name, values[:, k], None if sigma is None else sigma[:, k]) for name, k in columns], trace)


def _lines(
    columns: Sequence[tuple[str, Array, Array | None]], trace: Trace, of_modalities: bool = False
) -> list[Series]:
    """Lines with values, given by source, values (T,) and standard deviations (T,)."""

    def label(source: str) -> str:
        if of_modalities:
            return display_name(source)
        return "estimate" if source == "fused" and len(trace.modalities) < 2 else measures.layer_label(source)

    return [Series(label(name), name, values, sigma) for name, values, sigma in columns if np.isfinite(values).any()]
