"""Results of a study: tables, and bar charts as SVG, PDF and PNG."""

from __future__ import annotations

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

from beliefscope.datasets.catalog import TASKS
from beliefscope.datasets.task import Task
from beliefscope.filters.evaluate import STAY
from beliefscope.filters.training.study import Cell, write_tables
from beliefscope.filters.training.study_table import TRIVIAL, Document, Row
from beliefscope.inspect.diagnostics.plotting import FORMATS, STYLE, WIDTH, write_figure
from beliefscope.inspect.palette import COLOURS, SPARE_COLOURS

FAMILIES = {
    "crossmodal": COLOURS["fused"],
    "unimodal": SPARE_COLOURS[2],
    "feature": SPARE_COLOURS[1],
    "lstm": SPARE_COLOURS[0],
}
"""Colour of filters by the first word of their name, in addition to those of the modalities."""

SPARE = ("#000000", COLOURS["contact"], COLOURS["truth"])
"""Colours of other families of filters."""

HATCHES = {"pf": "/////", "ukf": "....."}
"""Hatching and lighter colour by kind of filter, for print and colour-blind readers."""

CLIP = 2.0
"""Multiple of the trivial predictor's error at which bars are clipped and labelled with their value."""

LINE_LIMIT = 2.0
"""Multiple of the tallest bar above which the trivial predictor's error is shown in the title instead of as a line."""


def write_study(folder: Path, cells: Sequence[Cell], preset: str) -> tuple[list[Row], Document]:
    """Writes the tables and figures of the finished cells; returns the rows and the content of ``study.json``."""
    rows, overview = write_tables(folder, cells, preset)
    write_results(rows, folder, {cell.task: cell.definition for cell in cells})
    return rows, overview


def write_results(rows: Sequence[Row], folder: Path, tasks: Mapping[str, Task] = TASKS) -> list[Path]:
    """Write ``results.svg``, ``results.pdf`` and ``results.png`` (300 dpi); see ``results``."""
    with rc_context(STYLE):
        figure = results(rows, tasks)
    paths = [folder / f"results.{suffix}" for suffix in FORMATS]
    for path in paths:
        write_figure(figure, path)
    return paths


def results(rows: Sequence[Row], tasks: Mapping[str, Task] = TASKS) -> Figure:
    """RMSE by probability of image blackout: one panel per task, start and quantity, one bar with spread per filter.

    The dashed line is the error of a predictor without observations (``reference``); if far above all bars, it is given
    in the title. A cross marks a filter without results.
    """
    filters = list(dict.fromkeys(row.filter for row in rows if row.filter != TRIVIAL))
    conditions = dict.fromkeys((r.task, r.start) for r in rows if r.filter != TRIVIAL)
    panels = [(task, start, key, title) for task, start in conditions for key, title in panels_of(tasks[task])]
    columns = min(2, len(panels))
    lines = -(-len(panels) // columns)
    legend_lines = -(-(len(filters) + 2) // 5)
    figure = Figure(figsize=(WIDTH, 2.0 * lines + 0.17 * legend_lines + 0.1), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(lines, columns, squeeze=False).flatten()
    for unused in axes[len(panels) :]:
        unused.set_axis_off()
    styles = bar_styles(filters)
    offsets = any(start for _, start in conditions)
    for axis, (task, start, key, title) in zip(axes, panels, strict=False):
        members = [r for r in rows if r.task == task and (r.start == start or r.filter == TRIVIAL)]
        bars(axis, members, key, styles)
        name = ("", ", offset start" if start else ", true start")[offsets]
        axis.set_title(f"{task}: {title}{name}", loc="left")
    handles: list[Patch | Line2D] = [Patch(label=name, **styles[name]) for name in filters]
    if any(line.get_linestyle() == "--" for axis in axes for line in axis.lines):
        dashed = f"{TRIVIAL}; {STAY} with offset" if offsets else TRIVIAL
        handles.append(Line2D([], [], color="black", linestyle="--", linewidth=0.8, label=dashed))
    if any(not row.seeds for row in rows if row.filter != TRIVIAL):
        handles.append(Line2D([], [], color="gray", linestyle="", marker="x", markersize=3, label="missing"))
    figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False, handlelength=1.6)
    return figure


def reference(rows: Sequence[Row], key: str) -> tuple[str, float | None]:
    """Name and error of a predictor without observations, for the rows of one start.

    With offset starts the baseline that keeps the start; at the truth the training mean.
    """
    if any(row.start for row in rows):
        return STAY, next((row.baselines[STAY].get(key) for row in rows if STAY in row.baselines), None)
    return TRIVIAL, next((row.mean[key] for row in rows if row.filter == TRIVIAL), None)


def panels_of(task: Task) -> list[tuple[str, str]]:
    """Keys and titles of the panels of a task: the position on the map, and each other component."""
    position = task.map_components[0].rpartition("_")[0] or "position"
    main = task.main_error
    others = [c for i, c in enumerate(task.components) if i not in main.indices]
    return [(main.key, position if main.name == "position" else main.name), *((c.key, c.name) for c in others)]


def bar_styles(filters: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Style of each filter's bars: colour by fusion, hatching by kind of filter."""
    unknown = [f for f in dict.fromkeys(name.rsplit("-", 1)[0] for name in filters) if f not in {**FAMILIES, **COLOURS}]
    others = {family: SPARE[i % len(SPARE)] for i, family in enumerate(unknown)}
    styles: dict[str, dict[str, Any]] = {}
    for name in filters:
        family, _, kind = name.rpartition("-")
        colour = np.array(to_rgb({**COLOURS, **FAMILIES, **others}[family or kind]))
        hatch = HATCHES.get(kind)
        face = colour if hatch is None else 0.45 * colour + 0.55
        styles[name] = {"facecolor": tuple(face), "edgecolor": tuple(0.55 * colour), "hatch": hatch, "linewidth": 0.4}
    return styles


def bars(axis: Axes, rows: Sequence[Row], key: str, styles: Mapping[str, Mapping[str, Any]]) -> None:
    """Draw one panel: groups of bars by probability of image blackout."""
    filters = [name for name in styles if any(row.filter == name for row in rows)]
    blackouts = list(dict.fromkeys(row.blackout for row in rows if row.blackout is not None))
    width = 0.84 / len(filters)
    name, mean = reference(rows, key)
    unit = key.rsplit("_", 1)[1]
    rows = [row for row in rows if row.filter != TRIVIAL]
    tops = [value + (row.spread.get(key) or 0.0) for row in rows if (value := row.mean.get(key)) is not None]
    top = max(tops, default=mean or 1.0)
    if mean is not None:
        top = min(max(top, mean) if mean < LINE_LIMIT * top else top, CLIP * mean)
        if mean <= top:
            axis.axhline(mean, color="black", linestyle="--", linewidth=0.8, zorder=3)
        else:
            axis.set_title(f"{name}: {mean:.1f} {unit}", loc="right", fontsize=7, color="#555555")
    for row in rows:
        if row.blackout is None:
            continue
        x = blackouts.index(row.blackout) + (filters.index(row.filter) - (len(filters) - 1) / 2) * width
        value, spread = row.mean.get(key), row.spread.get(key)
        if value is None:
            axis.plot(x, 0.03 * top, color="gray", marker="x", markersize=3, linestyle="")
            continue
        axis.bar(x, value, 0.92 * width, **styles[row.filter])
        if spread is not None:
            axis.errorbar(x, value, spread, color="black", linewidth=0.6, capsize=1.2, capthick=0.6, zorder=4)
        if value > top:
            box = {"facecolor": "white", "edgecolor": "none", "pad": 0.6}
            axis.text(x, 1.03 * top, f"{value:.0f}", rotation=90, ha="center", va="top", fontsize=6, zorder=5, bbox=box)
    axis.set_xlim(-0.5, len(blackouts) - 0.5)
    axis.set_ylim(0, 1.06 * top)
    axis.set_xticks(range(len(blackouts)), [f"{b:.0%}" for b in blackouts])
    axis.set_xlabel("image blackout")
    axis.tick_params(axis="x", length=0)
    axis.tick_params(axis="y", width=0.6, length=2)
    axis.set_ylabel(f"RMSE ({unit})")
    axis.set_axisbelow(True)
    axis.grid(axis="y", linewidth=0.3, color="#cccccc")
