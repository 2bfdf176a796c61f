"""Figures in a paper's size: their style, and the figure of any diagnostic."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from beliefscope.datasets.errors import one_of
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.inspect.diagnostics.base import Curve, Diagnostic, Picture, Plot
from beliefscope.inspect.palette import COLOURS, colour
from beliefscope.inspect.statistics.measures import stretches

STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 7,
    "axes.titlesize": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "hatch.linewidth": 0.4,
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "beliefscope",  # the same results give the same file
}

WIDTH = 7.16
"""Inches: two columns of a paper."""
MANY = 5000
"""Points of a plot among which looking for the best place of its legend takes seconds."""


FORMATS: dict[str, dict[str, Any]] = {
    "svg": {"metadata": {"Date": None}},
    "pdf": {"metadata": {"CreationDate": None}},
    "png": {"dpi": 300},
}
"""Formats of figures, and what makes the same numbers give the same file."""

BANDS = {
    "contact": {"facecolor": COLOURS["contact"], "alpha": 0.2},
    "blackout": {"facecolor": "#000000", "alpha": 0.12},
    "edit": {"facecolor": "#0072B2", "alpha": 0.12},
}

PANEL_HEIGHT = 1.5
"""Inches of a chart over time, which is as wide as the figure; plots and pictures: half as wide, 1.6 x as high."""


def write_figure(figure: Figure, path: Path) -> None:
    """Writes a figure as SVG, PDF or PNG (300 dpi), by the path's ending. Raises BadInput for another ending."""
    suffix = figure_format(path)
    data = io.BytesIO()
    with rc_context(STYLE):
        figure.savefig(data, format=suffix, **FORMATS[suffix])
    write_atomically(path, data.getvalue())


def figure_format(path: Path) -> str:
    """``svg``, ``pdf`` or ``png``, by the path's ending. Raises BadInput for another ending."""
    suffix = path.suffix.removeprefix(".").lower()
    if suffix not in FORMATS:
        raise one_of("format of a figure", suffix, FORMATS)
    return suffix


def figure_of(diagnostic: Diagnostic) -> Figure:
    """Curves by chart, one below the other; then plots and pictures, two a row; the verdict on top."""
    charts = charts_of(diagnostic)
    panels: list[Plot | Picture] = [*diagnostic.plots(), *diagnostic.pictures()]
    rows = len(charts) + -(-len(panels) // 2)
    with rc_context(STYLE):
        height = PANEL_HEIGHT * (len(charts) + 1.6 * -(-len(panels) // 2)) + 0.5
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(diagnostic.verdict, fontsize=8, x=0.01, ha="left", wrap=True)
        if not rows:
            return figure
        ratios = [1.0] * len(charts) + [1.6] * (rows - len(charts))
        grid = figure.add_gridspec(rows, 2, height_ratios=ratios)
        first = None
        for row, (name, curves) in enumerate(charts):
            first = axes = figure.add_subplot(grid[row, :], sharex=first)
            draw_chart(axes, name, curves, diagnostic)
        for i, panel in enumerate(panels):
            axes = figure.add_subplot(grid[len(charts) + i // 2, i % 2])
            draw_panel(axes, panel)
    return figure


def png_of(panel: Plot | Picture) -> bytes:
    """One plot or picture by itself as PNG, half as wide as a figure."""
    data = io.BytesIO()
    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH / 2, 1.6 * PANEL_HEIGHT), layout="constrained")
        FigureCanvasAgg(figure)
        draw_panel(figure.add_subplot(), panel)
        figure.savefig(data, format="png", dpi=200)
    return data.getvalue()


def charts_of(diagnostic: Diagnostic) -> list[tuple[str, list[Curve]]]:
    """The curves of each chart, under its name. Those of one chart are neighbours."""
    return [(name, list(curves)) for name, curves in groupby(diagnostic.curves(), key=lambda curve: curve.chart)]


def draw_chart(axes: Axes, name: str, curves: Sequence[Curve], diagnostic: Diagnostic) -> None:
    """Curves over steps, with the bands behind them and their bounds dashed."""
    steps = np.arange(len(curves[0].values))
    draw_bands(axes, diagnostic.bands())
    layers = [curve.layer for curve in curves]
    for i, curve in enumerate(curves):
        style = ("-", "--", ":", "-.")[layers[:i].count(curve.layer) % 4]
        axes.plot(steps, curve.values, label=curve.name, color=colour_of(curve.layer, layers), lw=1.0, ls=style)
    for bound in dict.fromkeys(b for curve in curves if curve.bounds for b in curve.bounds):
        axes.axhline(bound, color="black", lw=0.6, ls="--")
    axes.set_title(name, loc="left")
    axes.set_ylabel(curves[0].unit)
    axes.set_xlabel("step")
    axes.set_xlim(-0.5, len(steps) - 0.5)
    # Beside the title, where no curve is.
    axes.legend(frameon=False, ncols=4, loc="lower right", bbox_to_anchor=(1.0, 0.97), borderaxespad=0.0)


def draw_bands(axes: Axes, bands: Mapping[str, NDArray[np.bool_]], named: bool = False) -> None:
    """Shades the steps of each kind, half a step to both sides, behind all else. ``named``: for the legend."""
    for kind, mask in bands.items():
        if mask.any():
            spans = [(first - 0.5, end - first) for first, end in stretches(mask)]
            shade: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "lw": 0, "zorder": 0, **BANDS[kind]}
            axes.broken_barh(spans, (0, 1), label=kind if named else None, **shade)


def draw_panel(axes: Axes, panel: Plot | Picture) -> None:
    """What is not over time."""
    draw_plot(axes, panel) if isinstance(panel, Plot) else draw_picture(axes, panel)


def draw_plot(axes: Axes, plot: Plot) -> None:
    """Lines, points or bars."""
    layers = [line.layer for line in plot.lines]
    width = 0.8 / max(1, len(plot.lines))
    for i, line in enumerate(plot.lines):
        look: dict[str, Any] = {"label": line.name, "color": colour_of(line.layer, layers)}
        if plot.kind == "bars":
            axes.bar(np.asarray(line.x) + (i - (len(plot.lines) - 1) / 2) * width, line.y, 0.9 * width, **look)
        elif plot.kind == "points":
            axes.plot(line.x, line.y, ls="", marker="o", ms=2, **look)
        else:
            axes.plot(line.x, line.y, lw=1.0, **look)
    if plot.diagonal:
        axes.plot([0, 1], [0, 1], color="black", lw=0.6, ls="--")
    if plot.names:
        axes.set_xticks(range(len(plot.names)), [name.replace(" ", "\n", 1) for name in plot.names])
    axes.set_title(plot.title, loc="left")
    axes.set_xlabel(plot.x_label)
    axes.set_ylabel(plot.y_label)
    if any(line.name for line in plot.lines):
        many = sum(len(line.x) for line in plot.lines) > MANY
        axes.legend(frameon=False, loc="upper right" if many else "best")


def draw_picture(axes: Axes, picture: Picture) -> None:
    """Values per pixel; signed ones from blue through white to red."""
    limit = float(np.nanmax(np.abs(picture.values))) or 1.0
    low, shades = (-limit, "RdBu_r") if picture.signed else (float(np.nanmin(picture.values)), "viridis")
    drawn = axes.imshow(picture.values, cmap=shades, vmin=low, vmax=limit)
    axes.figure.colorbar(drawn, ax=axes, label=picture.unit)
    axes.set_title(picture.title, loc="left")
    axes.set_axis_off()


def colour_of(layer: str, layers: Sequence[str]) -> str:
    """The layer's colour; black for a curve that belongs to none."""
    named = list(dict.fromkeys(one for one in layers if one))
    return colour(layer, named) if layer else "#333333"


@cache
def colour_table(name: str) -> NDArray[np.uint8]:
    """(256, 3) RGB of a colour map of matplotlib's, from its low end to its high one."""
    shades = np.asarray(colormaps[name](np.linspace(0.0, 1.0, 256)))
    return np.rint(255.0 * shades[:, :3]).astype(np.uint8)
