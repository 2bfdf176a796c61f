"""The charts of the timeline as a figure for one column of a paper."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.inspect.diagnostics import plotting
from beliefscope.inspect.diagnostics.plotting import BANDS, STYLE, StepAxis, draw_legend, legend_height, new_figure
from beliefscope.inspect.figures.timeline import Timeline
from beliefscope.inspect.figures.timeline_charts import Chart, Series, value_range
from beliefscope.inspect.palette import COLOURS, SPARE_COLOURS, colour
from beliefscope.inspect.statistics.measures import intervals

if TYPE_CHECKING:  # functions import matplotlib when they draw
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = (*plotting.FORMATS, "csv")
"""Formats of files of a timeline."""

WIDTH = 8.5 / 2.54
"""Inches: one column of a paper."""
CHART_HEIGHT = 0.85
"""Inches, without title and legend."""
NARROW = {
    "axes.titlesize": STYLE["font.size"],
    "legend.handlelength": 1.5,
    "legend.handletextpad": 0.5,
    "legend.columnspacing": 1.2,
}
"""Style of titles and legends that leaves room in one column."""
TITLE_HEIGHT = 0.25
"""Inches, of a title, and of the label of the horizontal axis."""

CHANNEL_COLOURS = tuple(SPARE_COLOURS[i] for i in (7, 2, 3, 5, 4, 6, 0, 1))
"""Colours of channels of sensors, as on the page."""

DASHES: dict[str, tuple[float, ...]] = {"truth": (), "fused": (), "image": (4.7, 2.0), "haptics": (1.3, 1.7)}
SPARE_DASHES = ((6.0, 2.0, 1.3, 2.0), (2.7, 1.3), (0.7, 2.0), (8.0, 2.0), (4.0, 1.3, 0.7, 1.3, 0.7, 1.3), (2.0, 3.3))
"""Dashes in widths of the line: sources differ without colour too."""
WIDTHS = {"truth": 0.8, "fused": 1.3}
LINE_WIDTH = 0.9
"""Points, of the lines of modalities and channels."""
COMPARISON: dict[str, Any] = {"lw": 0.6, "alpha": 0.65}
"""Lines of the comparison run."""

OPACITIES = (0.75, 0.45)
"""Of stacked areas, from below: neighbours differ without colour too."""

FAULT_COLOUR = "#b3261e"
STRIPS: dict[str, tuple[tuple[float, float], dict[str, Any]]] = {
    "injected fault": ((0.955, 1.0), {"facecolor": FAULT_COLOUR}),
    "image blackout": ((0.86, 0.935), {"facecolor": "#cccccc", "edgecolor": "#333333", "hatch": 12 * "/"}),
}
"""Marks above the values: lower and upper edge as shares of the height of a chart, and style."""
STRIPS_HEIGHT = 0.16
"""Share of the height of a chart above its values, if it has such marks."""
GROUP_STRIP = (0.0, 0.09)
"""The group of steps in a chart that is filled with areas."""


def encoded_timeline(timeline: Timeline, format: str) -> bytes:
    """The file in one of ``FORMATS``: the figure, or the values as CSV."""
    if format == "csv":
        return timeline.csv().encode()
    return plotting.encoded_figure(timeline_figure(timeline), format)


def timeline_figure(timeline: Timeline) -> Figure:
    """The charts below one another over the visible steps. A label is in the legend of the first chart that has it."""
    trace, in_seconds = timeline.trace, timeline.view.seconds
    axis = StepAxis.from_times(len(trace), timeline.time if in_seconds else None)
    from matplotlib import rc_context

    with rc_context(STYLE | NARROW):
        figure = new_figure(layout="constrained")
        rows = figure.subplots(len(timeline.charts), 1, sharex=True, squeeze=False)[:, 0]
        heights, known = [], set[str]()
        for axes, chart in zip(rows, timeline.charts, strict=True):
            _draw_chart(axes, chart, timeline, axis)
            if timeline.comparison is not None:
                axes.plot([], [], color="black", label="comparison run", **COMPARISON)
            for artist in axes.get_children():
                if artist.get_label() in known:
                    artist.set_label("_")
                known.add(str(artist.get_label()))
            labels = axes.get_legend_handles_labels()[1]
            heights.append(CHART_HEIGHT + TITLE_HEIGHT + legend_height(labels, chart.title, WIDTH))
            draw_legend(axes, chart.title, WIDTH)
        figure.set_size_inches(WIDTH, sum(heights) + TITLE_HEIGHT)
        rows[0].set_xlim(*np.interp(timeline.window, np.arange(len(trace)), axis.positions))
        rows[-1].set_xlabel(axis.label if in_seconds else f"step ({trace.episode.duration_text} each)")
        figure.align_ylabels(rows)
    return figure


def _draw_chart(axes: Axes, chart: Chart, timeline: Timeline, axis: StepAxis) -> None:
    first, last = int(timeline.window[0]), int(np.ceil(timeline.window[1]))
    low, high = value_range(chart, first, last)
    room = STRIPS_HEIGHT / (1.0 - STRIPS_HEIGHT) if timeline.bands.keys() & STRIPS.keys() else 0.0
    axes.set_ylim(low, high * (high / low) ** room if chart.bounds else high + room * (high - low))
    if chart.bounds:
        axes.set_yscale("log")
        axes.axhspan(*chart.bounds, facecolor=COLOURS["truth"], alpha=0.1, lw=0, label="95 % interval")
        for bound in chart.bounds:
            axes.axhline(bound, color="#666666", lw=0.5, ls="--")
    part = slice(first, last + 1)  # a small file if few of many steps are visible
    areas = [line for line in chart.series if line.stacked]
    _draw_areas(axes, areas, timeline, axis.edges[first : last + 2], part)
    _draw_bands(axes, timeline, axis, bool(areas))
    for line in chart.series:
        if not line.stacked:
            _draw_line(axes, line, timeline, axis.positions[part], part)
    axes.set_ylabel(chart.unit)


def _draw_areas(
    axes: Axes, areas: Sequence[Series], timeline: Timeline, edges: NDArray[np.float64], part: slice
) -> None:
    """Stack the values of each step, with a line between two areas; of the comparison run only the lines, in white."""
    for comparison, ink in ((False, "black"), (True, "white")):
        lines = [line for line in areas if line.comparison == comparison]
        below = np.zeros(len(edges) - 1)
        for i, line in enumerate(lines):
            above = below + line.values[part]
            if not comparison:
                style: dict[str, Any] = {
                    "color": _colour(line, timeline),
                    "alpha": OPACITIES[i % len(OPACITIES)],
                    "lw": 0,
                }
                axes.stairs(above, edges, baseline=below, fill=True, label=line.name, **style)
            if i + 1 < len(lines):
                axes.stairs(above, edges, baseline=None, color=ink, lw=0.6)
            below = above


def _draw_bands(axes: Axes, timeline: Timeline, axis: StepAxis, has_areas: bool) -> None:
    """Mark steps: over the height of the chart, or along an edge where a shade would change the colours of areas."""
    for name, mask in timeline.bands.items():
        (low, high), style = STRIPS.get(name, ((0.0, 1.0), BANDS.get(name, BANDS["contact"])))
        if has_areas and name == timeline.group:
            (low, high), style = GROUP_STRIP, {"facecolor": COLOURS["contact"]}
        spans = [(axis.edges[first], axis.edges[end] - axis.edges[first]) for first, end in intervals(mask)]
        shade: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "lw": 0, "label": name, **style}
        axes.broken_barh(spans, (low, high - low), zorder=1.5 if has_areas else 0.5, **shade)


def _draw_line(axes: Axes, line: Series, timeline: Timeline, positions: NDArray[np.float64], part: slice) -> None:
    """Draw a line with its band of two standard deviations; of the comparison run thinner and lighter."""
    shade, values = _colour(line, timeline), line.values[part]
    if line.sigma is not None:
        width = 2.0 * line.sigma[part]
        centre = np.zeros(len(width)) if line.around_zero else values
        alpha, label = (
            (0.2, "\N{PLUS-MINUS SIGN}2\N{GREEK SMALL LETTER SIGMA}") if line.source == "fused" else (0.08, None)
        )
        axes.fill_between(positions, centre - width, centre + width, color=shade, alpha=alpha, lw=0, label=label)
    dashes = _dashes(line, timeline)
    style: dict[str, Any] = {"color": shade, "lw": WIDTHS.get(str(line.source), LINE_WIDTH)}
    if line.comparison:
        style |= COMPARISON
    known = np.isfinite(values)
    alone = known & ~np.append(known[1:], False) & ~np.append(False, known[:-1])  # a line does not show them
    axes.plot(positions, values, ls=(0, dashes) if dashes else "-", label=line.name, **style)
    if alone.any():
        axes.plot(positions[alone], values[alone], ls="", marker="o", ms=1.5, color=shade)


def _colour(line: Series, timeline: Timeline) -> str:
    if isinstance(line.source, int):
        return CHANNEL_COLOURS[line.source % len(CHANNEL_COLOURS)]
    return colour(line.source, _modalities(line, timeline))


def _dashes(line: Series, timeline: Timeline) -> tuple[float, ...]:
    """Lengths of dashes and gaps in widths of the line; empty for a solid line."""
    if isinstance(line.source, int):
        repeat = line.source // len(CHANNEL_COLOURS)
        return SPARE_DASHES[(repeat - 1) % len(SPARE_DASHES)] if repeat else ()
    if line.source in DASHES:
        return DASHES[line.source]
    unnamed = [name for name in _modalities(line, timeline) if name not in DASHES]
    return SPARE_DASHES[unnamed.index(line.source) % len(SPARE_DASHES)]


def _modalities(line: Series, timeline: Timeline) -> tuple[str, ...]:
    """The modalities of the run, in whose order colours and dashes are assigned, and that of the line."""
    return tuple(dict.fromkeys([*timeline.trace.modalities, str(line.source)]))
