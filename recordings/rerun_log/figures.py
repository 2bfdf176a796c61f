"""Figures for paper: bars of a study's results, as SVG and PNG."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.task import Task
from beliefscope.filters.training.study import TRIVIAL, Row
from beliefscope.inspect.diagnostics.plotting import STYLE, WIDTH
from beliefscope.inspect.palette import COLOURS, SPARE_COLOURS

FAMILIES = {
    "crossmodal": COLOURS["fused"],
    "unimodal": SPARE_COLOURS[2],
    "feature": SPARE_COLOURS[1],
    "lstm": SPARE_COLOURS[0],
}
"""Colour of filters by the first word of their name, beside those of the modalities."""

OTHERS = ("#000000", COLOURS["contact"], COLOURS["truth"])
"""For families of filters that have no colour of their own."""

HATCHES = {"pf": "/////", "ukf": "....."}
"""Kinds of filters are told apart by hatching, and are lighter, so that print and any eye can."""

TALLEST = 2.0
"""Times the trivial predictor's error: taller bars are cut off there, and say their value."""

HIGHEST = 2.0
"""Times the tallest bar: above, the trivial predictor's line would press all bars flat; its error is in the title."""


def write_results(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Writes ``results.svg`` and ``results.png`` (300 dpi) of a study's table; see ``results``."""
    paths = []
    with rc_context(STYLE):
        figure = results(rows)
        for suffix, options in (("svg", {"metadata": {"Date": None}}), ("png", {"dpi": 300})):
            data = io.BytesIO()
            figure.savefig(data, format=suffix, **options)
            paths.append(folder / f"results.{suffix}")
            write_atomically(paths[-1], data.getvalue())
    return paths


def results(rows: Sequence[Row]) -> Figure:
    """RMSE by chance of black pictures: a panel for each task and quantity, a bar for each filter, spread on top.

    The dashed line is the error of always predicting the training mean; far above all bars, it is told in the title. A
    filter without a finished seed has a cross in its place.
    """
    filters = list(dict.fromkeys(row.filter for row in rows if row.filter != TRIVIAL))
    panels = [(task, key, title) for task in dict.fromkeys(r.task for r in rows) for key, title in shown(task)]
    columns = min(2, len(panels))
    lines = -(-len(panels) // columns)
    legend_lines = -(-(len(filters) + 2) // 5)
    figure = Figure(figsize=(WIDTH, 1.85 * lines + 0.17 * legend_lines + 0.1), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(lines, columns, squeeze=False).flatten()
    for unused in axes[len(panels) :]:
        unused.set_axis_off()
    look = looks(filters)
    for axis, (task, key, title) in zip(axes, panels, strict=False):
        bars(axis, [r for r in rows if r.task == task], key, look)
        axis.set_title(f"{task}: {title}", loc="left")
    handles: list[Patch | Line2D] = [Patch(label=name, **look[name]) for name in filters]
    if any(line.get_linestyle() == "--" for axis in axes for line in axis.lines):
        handles.append(Line2D([], [], color="black", linestyle="--", linewidth=0.8, label=TRIVIAL))
    if any(not row.seeds for row in rows if row.filter != TRIVIAL):
        handles.append(Line2D([], [], color="gray", linestyle="", marker="x", markersize=3, label="missing"))
    figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False, handlelength=1.6)
    return figure


def shown(task_name: str) -> list[tuple[str, str]]:
    """Keys and titles of the panels of a task: the place on the map, and each component that is not of it."""
    task: Task = find_task(task_name)
    place = task.map_components[0].rpartition("_")[0] or "position"
    rest = [c for c in task.components if c.name not in task.map_components]
    keys = {"m": "cm", "rad": "deg"}
    return [("position_cm", place), *((f"{c.name}_{keys[c.unit]}", c.name) for c in rest)]


def looks(filters: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Face, edge and hatching of each filter's bars: a colour for what it fuses, hatching for how it filters."""
    unknown = [f for f in dict.fromkeys(name.rsplit("-", 1)[0] for name in filters) if f not in {**FAMILIES, **COLOURS}]
    others = {family: OTHERS[i % len(OTHERS)] for i, family in enumerate(unknown)}
    look: dict[str, dict[str, Any]] = {}
    for name in filters:
        family, _, kind = name.rpartition("-")
        colour = np.array(to_rgb({**COLOURS, **FAMILIES, **others}[family or kind]))
        hatch = HATCHES.get(kind)
        face = colour if hatch is None else 0.45 * colour + 0.55
        look[name] = {"facecolor": tuple(face), "edgecolor": tuple(0.55 * colour), "hatch": hatch, "linewidth": 0.4}
    return look


def bars(axis: Axes, rows: Sequence[Row], key: str, look: Mapping[str, Mapping[str, Any]]) -> None:
    """One panel: groups of bars by chance of black pictures."""
    filters = [name for name in look if any(row.filter == name for row in rows)]
    blackouts = list(dict.fromkeys(row.blackout for row in rows if row.blackout is not None))
    width = 0.84 / len(filters)
    mean = next((row.mean[key] for row in rows if row.filter == TRIVIAL), None)
    unit = key.rsplit("_", 1)[1]
    rows = [row for row in rows if row.filter != TRIVIAL]
    known = [value + (row.spread.get(key) or 0.0) for row in rows if (value := row.mean.get(key)) is not None]
    top = max(known, default=mean or 1.0)
    if mean is not None:
        top = min(max(top, mean) if mean < HIGHEST * top else top, TALLEST * mean)
        if mean <= top:
            axis.axhline(mean, color="black", linestyle="--", linewidth=0.8, zorder=3)
        else:
            axis.set_title(f"{TRIVIAL}: {mean:.1f} {unit}", loc="right", fontsize=7, color="#555555")
    for row in rows:
        if row.blackout is None:
            continue
        x = blackouts.index(row.blackout) + (filters.index(row.filter) - (len(filters) - 1) / 2) * width
        value, spread = row.mean.get(key), row.spread.get(key)
        if value is None:
            axis.plot(x, 0.03 * top, color="gray", marker="x", markersize=3, linestyle="")
            continue
        axis.bar(x, value, 0.92 * width, **look[row.filter])
        if spread is not None:
            axis.errorbar(x, value, spread, color="black", linewidth=0.6, capsize=1.2, capthick=0.6, zorder=4)
        if value > top:
            box = {"facecolor": "white", "edgecolor": "none", "pad": 0.6}
            axis.text(x, 1.03 * top, f"{value:.0f}", rotation=90, ha="center", va="top", fontsize=6, zorder=5, bbox=box)
    axis.set_xlim(-0.5, len(blackouts) - 0.5)
    axis.set_ylim(0, 1.06 * top)
    axis.set_xticks(range(len(blackouts)), [f"{b:.0%} black pictures" for b in blackouts])
    axis.tick_params(axis="x", length=0)
    axis.tick_params(axis="y", width=0.6, length=2)
    axis.set_ylabel(f"RMSE ({unit})")
    axis.set_axisbelow(True)
    axis.grid(axis="y", linewidth=0.3, color="#cccccc")
