"""Matplotlib figures of diagnostics in a paper's width."""

from __future__ import annotations

import io
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import check_name
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.inspect.diagnostics.views import Curve, ImagePanel, Plot, Views
from beliefscope.inspect.palette import COLOURS, colour
from beliefscope.inspect.statistics.measures import intervals

if TYPE_CHECKING:  # functions import matplotlib when they draw: it takes half a second
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 7,
    "axes.titlesize": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "hatch.linewidth": 0.4,
    "svg.fonttype": "none",  # text stays text
    "pdf.fonttype": 42,  # embedded TrueType fonts; journals refuse Type 3
    "svg.hashsalt": "beliefscope",  # reproducible files
}

WIDTH = 7.16
"""Inches: two columns of a paper."""
MAX_LEGEND_POINTS = 5000
"""Number of points above which matplotlib takes seconds to find the best legend position."""


FORMATS: dict[str, dict[str, Any]] = {
    "svg": {"metadata": {"Date": None}},
    "pdf": {"metadata": {"CreationDate": None}},
    "png": {"dpi": 300},
}
"""Figure formats with options for reproducible files."""

BANDS = {
    "contact": {"facecolor": COLOURS["contact"], "alpha": 0.2},
    "blackout": {"facecolor": "#000000", "alpha": 0.12},
    "intervention": {"facecolor": "#0072B2", "alpha": 0.12},
}
OTHER_BAND = {"facecolor": "#999999", "alpha": 0.25}

LEGEND_ROW = 1.5
"""Height of a row of a legend in font sizes."""

MARGIN = 0.75
"""Inches beside the axes of a chart."""

PANEL_HEIGHT = 1.5
"""Inches, height of a full-width chart over time; plots and image panels are half as wide and 1.6 x as high."""


@dataclass(frozen=True)
class StepAxis:
    """Horizontal axis of charts over the T steps of a trace.

    Attributes:
        positions: (T,) of the steps. edges: (T + 1,) between the steps, and as far before the first and after the last.
    """

    positions: NDArray[np.float64]
    edges: NDArray[np.float64]
    label: str

    @classmethod
    def from_times(cls, steps: int, time: NDArray[np.float64] | None) -> StepAxis:
        """The times (T,) in s where the data have timestamps, else the indices of the steps."""
        positions = np.arange(steps, dtype=np.float64) if time is None else time
        middles = 0.5 * (positions[1:] + positions[:-1])
        half = (middles[:1] - positions[:1], positions[-1:] - middles[-1:]) if steps > 1 else (0.5, 0.5)
        edges = np.concatenate([positions[:1] - half[0], middles, positions[-1:] + half[1]])
        return cls(positions, edges, "step" if time is None else "time (s)")


def write_figure(figure: Figure, path: Path) -> None:
    """Write a figure as SVG, PDF or PNG (300 dpi) depending on the suffix. Raises BadInput for other suffixes."""
    write_atomically(path, encoded_figure(figure, figure_format(path)))


def encoded_figure(figure: Figure, format: str) -> bytes:
    """The file of a figure in one of ``FORMATS``."""
    data = io.BytesIO()
    from matplotlib import rc_context

    with rc_context(STYLE):
        figure.savefig(data, format=format, **FORMATS[format])
    return data.getvalue()


def figure_format(path: Path, formats: Container[str] = FORMATS) -> str:
    """``svg``, ``pdf`` or ``png`` depending on the suffix. Raises BadInput for a suffix of no format."""
    suffix = path.suffix.removeprefix(".").lower()
    check_name("figure format", suffix, formats)
    return suffix


def new_figure(**settings: Any) -> Figure:
    """A figure with a canvas of its own, independent of pyplot; settings as for matplotlib's ``Figure``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from beliefscope.inspect.displayed_figure import DisplayedFigure

    figure = DisplayedFigure(**settings)
    FigureCanvasAgg(figure)
    return figure


def draw_figure(diagnostic: Views, time: NDArray[np.float64] | None = None) -> Figure:
    """Draw the verdict, charts below one another, then plots and image panels, two per row.

    Args:
        time: (T,) s, times of the steps of the charts; None to draw them over the indices of the steps.
    """
    charts = charts_of(diagnostic)
    panels: list[Plot | ImagePanel] = [*diagnostic.plots(), *diagnostic.images()]
    rows = len(charts) + -(-len(panels) // 2)
    from matplotlib import rc_context

    with rc_context(STYLE):
        heights = [PANEL_HEIGHT + legend_height([curve.name for curve in curves], name) for name, curves in charts]
        heights += [1.6 * PANEL_HEIGHT] * (rows - len(charts))
        height = sum(heights) + 0.5
        figure = new_figure(figsize=(WIDTH, height), layout="constrained")
        figure.suptitle(diagnostic.verdict, fontsize=8, x=0.01, ha="left", wrap=True)
        if not rows:
            return figure
        grid = figure.add_gridspec(rows, 2, height_ratios=heights)
        first = None
        for row, (name, curves) in enumerate(charts):
            first = axes = figure.add_subplot(grid[row, :], sharex=first)
            draw_chart(axes, name, curves, diagnostic, time)
        for i, panel in enumerate(panels):
            axes = figure.add_subplot(grid[len(charts) + i // 2, i % 2])
            draw_panel(axes, panel)
    return figure


def panel_png(panel: Plot | ImagePanel) -> bytes:
    """Draw one plot or image panel as PNG, half as wide as a figure."""
    data = io.BytesIO()
    from matplotlib import rc_context

    with rc_context(STYLE):
        figure = new_figure(figsize=(WIDTH / 2, 1.6 * PANEL_HEIGHT), layout="constrained")
        draw_panel(figure.add_subplot(), panel)
        figure.savefig(data, format="png", dpi=200)
    return data.getvalue()


def charts_of(diagnostic: Views) -> list[tuple[str, list[Curve]]]:
    """Charts by title with their curves; curves of one chart are consecutive."""
    return [(name, list(curves)) for name, curves in groupby(diagnostic.curves(), key=lambda curve: curve.chart)]


def draw_chart(
    axes: Axes, name: str, curves: Sequence[Curve], diagnostic: Views, time: NDArray[np.float64] | None
) -> None:
    """Draw curves over steps or their times with shaded bands and dashed bounds."""
    axis = StepAxis.from_times(len(curves[0].values), time)
    draw_bands(axes, diagnostic.bands(), axis)
    layers = [curve.layer for curve in curves]
    for i, curve in enumerate(curves):
        style = ("-", "--", ":", "-.")[layers[:i].count(curve.layer) % 4]
        axes.plot(
            axis.positions, curve.values, label=curve.name, color=colour_of(curve.layer, layers), lw=1.0, ls=style
        )
    for bound in dict.fromkeys(b for curve in curves if curve.bounds for b in curve.bounds):
        axes.axhline(bound, color="black", lw=0.6, ls="--")
    axes.set_ylabel(curves[0].unit)
    axes.set_xlabel(axis.label)
    axes.set_xlim(axis.edges[0], axis.edges[-1])
    draw_legend(axes, name)


def draw_legend(axes: Axes, title: str = "", width: float = WIDTH) -> None:
    """Draw the title above the axes, and the legend beside it where there is room, else in rows below it.

    width: of the figure in inches.
    """
    labels = axes.get_legend_handles_labels()[1]
    columns, rows = _legend_layout(labels, title, width)
    style: dict[str, Any] = {"frameon": False, "ncols": columns, "borderaxespad": 0.0}
    if not labels:
        axes.set_title(title, loc="left")
    elif rows == 0:
        axes.set_title(title, loc="left")
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.97), **style)
    else:
        axes.set_title(title, loc="left", pad=(LEGEND_ROW * rows + 1.0) * STYLE["font.size"])
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 0.97), **style)


def legend_height(labels: Sequence[str], title: str = "", width: float = WIDTH) -> float:
    """Inches that the rows of a legend below its title need. width: of the figure in inches."""
    return _legend_layout(labels, title, width)[1] * LEGEND_ROW * float(STYLE["font.size"]) / 72.0


def _legend_layout(labels: Sequence[str], title: str, width: float) -> tuple[int, int]:
    """Columns of a legend, and rows between title and axes: 0 beside the title; as many columns as have room."""
    from matplotlib import rcParams
    from matplotlib.textpath import TextPath

    size, available = float(STYLE["font.size"]), 72.0 * (width - MARGIN)
    handle, spaces = (
        rcParams["legend.handlelength"],
        rcParams["legend.handletextpad"] + rcParams["legend.columnspacing"],
    )
    widths = [
        size * (handle + spaces) + TextPath((0, 0), text, size=size).get_extents().width for text in labels if text
    ]
    head = TextPath((0, 0), title, size=STYLE["axes.titlesize"]).get_extents().width if title else 0.0
    if head + 2.0 * size + sum(widths) <= available:
        return max(1, len(widths)), 0
    for columns in range(len(widths), 1, -1):
        rows = -(-len(widths) // columns)
        used = -(-len(widths) // rows)  # entries fill one column after the other
        if sum(max(widths[i * rows : (i + 1) * rows]) for i in range(used)) <= available:
            return used, rows
    return 1, max(1, len(widths))


def draw_bands(axes: Axes, bands: Mapping[str, NDArray[np.bool_]], axis: StepAxis, labelled: bool = False) -> None:
    """Shade the steps of each phase, extended by half a step on both sides. ``labelled``: add legend entries."""
    for phase, mask in bands.items():
        if mask.any():
            edges = axis.edges
            spans = [(edges[first], edges[end] - edges[first]) for first, end in intervals(mask)]
            style = BANDS.get(phase, OTHER_BAND)
            shade: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "lw": 0, "zorder": 0, **style}
            axes.broken_barh(spans, (0, 1), label=phase if labelled else None, **shade)


def draw_panel(axes: Axes, panel: Plot | ImagePanel) -> None:
    """Draw a plot or an image panel."""
    draw_plot(axes, panel) if isinstance(panel, Plot) else draw_image(axes, panel)


def draw_plot(axes: Axes, plot: Plot) -> None:
    """Draw lines, points or bars."""
    layers = [line.layer for line in plot.lines]
    width = 0.8 / max(1, len(plot.lines))
    for i, line in enumerate(plot.lines):
        style: dict[str, Any] = {"label": line.name, "color": colour_of(line.layer, layers)}
        if plot.kind == "bars":
            axes.bar(np.asarray(line.x) + (i - (len(plot.lines) - 1) / 2) * width, line.y, 0.9 * width, **style)
        elif plot.kind == "points":
            axes.plot(line.x, line.y, ls="", marker="o", ms=2, **style)
        else:
            axes.plot(line.x, line.y, lw=1.0, **style)
    if plot.diagonal:
        axes.plot([0, 1], [0, 1], color="black", lw=0.6, ls="--")
    if plot.names:
        axes.set_xticks(range(len(plot.names)), [name.replace(" ", "\n", 1) for name in plot.names])
    axes.set_title(plot.title, loc="left")
    axes.set_xlabel(plot.x_label)
    axes.set_ylabel(plot.y_label)
    if any(line.name for line in plot.lines) and plot.kind == "bars":  # beside them, as bars have no free corner
        axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    elif any(line.name for line in plot.lines):
        points = sum(len(line.x) for line in plot.lines)
        axes.legend(frameon=False, loc="upper right" if points > MAX_LEGEND_POINTS else "best")


def draw_image(axes: Axes, image: ImagePanel) -> None:
    """Draw values per pixel; signed values from blue through white to red."""
    limit = float(np.nanmax(np.abs(image.values))) or 1.0
    low, colours = (-limit, "RdBu_r") if image.signed else (float(np.nanmin(image.values)), "viridis")
    mappable = axes.imshow(image.values, cmap=colours, vmin=low, vmax=limit)
    axes.figure.colorbar(mappable, ax=axes, label=image.unit)
    axes.set_title(image.title, loc="left")
    axes.set_axis_off()


def colour_of(layer: str, layers: Sequence[str]) -> str:
    """Colour of a layer; dark gray without a layer."""
    names = list(dict.fromkeys(name for name in layers if name))
    return colour(layer, names) if layer else "#333333"
