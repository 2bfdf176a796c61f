"""Diagnostics in a recording: Rerun entities and their layout."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnostics.base import Diagnostic
from beliefscope.inspect.diagnostics.plotting import charts_of, panel_png
from beliefscope.inspect.diagnostics.views import Curve, ImagePanel, Plot, Table, Value
from beliefscope.inspect.palette import colour
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.rerun_log.entities import line, rgba, series, time_columns

NEUTRAL_COLOUR = "#9A9A9A"
"""Of bounds and of curves without a layer."""

TAB_HEIGHT, TEXT_HEIGHT, AXIS_HEIGHT, LANE_HEIGHT, CHART_HEIGHT = 800.0, 230.0, 56.0, 41.0, 110.0
"""Points: of a tab in a typical window, its text, the axis and each lane of the bands, and a chart at least."""

BAND_COLOURS = {"contact": "#CC79A7", "blackout": "#808080", "intervention": "#0072B2"}


def log_diagnostic(stream: rr.RecordingStream | None, diagnostic: Diagnostic, name: str, trace: Trace) -> None:
    """Log a diagnostic under ``diagnostics/{name}`` (paths: docs/recordings.md).

    Args:
        stream: None for Rerun's current recording stream.
        name: of an entry of ``DIAGNOSTICS``, which provides title and question, or another name.
        trace: with the steps of the curves. Diagnostics of several traces have no curves.

    Raises:
        BadInput: the numbers of steps of the curves and of the trace differ.
    """
    root = f"diagnostics/{slug(name)}"
    rr.log(
        f"{root}/about",
        rr.TextDocument(markdown(diagnostic, name), media_type="text/markdown"),
        static=True,
        recording=stream,
    )
    times = time_columns(trace.episode, np.arange(len(trace)))
    for chart, curves in charts_of(diagnostic):
        layers = [curve.layer for curve in curves]
        for i, curve in enumerate(curves):
            if len(curve.values) != len(trace):
                raise BadInput(
                    f"{name} has curves of {len(curve.values)} steps, but the trace has {len(trace)} steps: "
                    "log it with its own trace"
                )
            path = f"{root}/curves/{slug(chart)}/{slug(curve.name)}"
            rr.log(path, _line(curve, layers, layers[:i].count(curve.layer)), static=True, recording=stream)
            rr.send_columns(path, times, series(curve.values), recording=stream)
        bounds = sorted({b for curve in curves if curve.bounds for b in curve.bounds if np.isfinite(b)})
        if bounds:
            path = f"{root}/bounds/{slug(chart)}"
            ends = np.unique([0, len(trace) - 1])
            rr.log(path, line(NEUTRAL_COLOUR, 0.8, *["bounds"] * len(bounds)), static=True, recording=stream)
            rr.send_columns(
                path,
                time_columns(trace.episode, ends),
                series(np.tile(np.array(bounds), (len(ends), 1))),
                recording=stream,
            )
    for kind, mask in _bands(diagnostic).items():
        _log_band(stream, f"{root}/bands/{slug(kind)}", kind, mask, trace)
    for where, panels in (("plots", diagnostic.plots()), ("images", diagnostic.images())):
        for panel in panels:
            image = rr.EncodedImage(contents=panel_png(panel), media_type="image/png")
            rr.log(f"{root}/{where}/{slug(panel.title)}", image, static=True, recording=stream)


def diagnostic_tab(diagnostic: Diagnostic, name: str) -> rrb.Container:
    """Layout of a diagnostic logged by ``log_diagnostic``: text, plots and images above, curves below."""
    root = f"diagnostics/{slug(name)}"
    panels: list[tuple[str, Plot | ImagePanel]] = [
        *(("plots", plot) for plot in diagnostic.plots()),
        *(("images", image) for image in diagnostic.images()),
    ]
    views = [
        rrb.TextDocumentView(origin=f"{root}/about", name="Verdict"),
        *(rrb.Spatial2DView(origin=f"{root}/{where}/{slug(p.title)}", name=p.title) for where, p in panels),
    ]
    rows: list[rrb.View | rrb.Container] = [rrb.Tabs(*views, active_tab=0)]
    heights = [TEXT_HEIGHT]
    linked = rrb.TimeAxis(link="LinkToGlobal")
    charts, bands = charts_of(diagnostic), _bands(diagnostic)
    if charts and bands:
        rows.append(rrb.StateTimelineView(origin=f"{root}/bands", name="Phases", time_view=linked))
        heights.append(AXIS_HEIGHT + LANE_HEIGHT * len(bands))
    for chart, curves in charts:
        unit = curves[0].unit
        rows.append(
            rrb.TimeSeriesView(
                origin=f"{root}/curves/{slug(chart)}",
                contents=["$origin/**", f"/{root}/bounds/{slug(chart)}"],
                name=chart if unit.lower() in chart.lower() else f"{chart} ({unit})",
                axis_x=linked,
                plot_legend=rrb.PlotLegend(corner="LeftTop"),
            )
        )
    heights += [max(CHART_HEIGHT, (TAB_HEIGHT - sum(heights)) / len(charts))] * len(charts) if charts else []
    return rrb.Vertical(*rows, row_shares=heights, name=title_of(name))


def title_of(name: str) -> str:
    """Title of a diagnostic in the catalog; the name of any other."""
    return DIAGNOSTICS[name].title if name in DIAGNOSTICS else name


def slug(name: str) -> str:
    """A name as one part of a path: lower-case letters and digits, joined by ``_``."""
    return re.sub(r"\W+", "_", name.lower()).strip("_") or "_"


def markdown(diagnostic: Diagnostic, name: str) -> str:
    """Title, question, verdict and tables as Markdown, including a table of the curves."""
    question = [f"*{DIAGNOSTICS[name].question}*"] if name in DIAGNOSTICS else []
    tables = diagnostic.tables()
    if curves := diagnostic.curves():
        rows = [(curve.chart, curve.name, curve.unit, *(curve.bounds or (None, None))) for curve in curves]
        tables = [*tables, Table("Curves", ("chart", "curve", "unit", "lower bound", "upper bound"), tuple(rows))]
    return "\n\n".join([f"# {title_of(name)}", *question, diagnostic.verdict, *map(_table, tables)]) + "\n"


def _table(table: Table) -> str:
    rows = [table.columns, ["---"] * len(table.columns), *([_cell(value) for value in row] for row in table.rows)]
    return "\n".join([f"## {table.title}", "", *(f"| {' | '.join(row)} |" for row in rows)])


def _cell(value: Value) -> str:
    text = "-" if value is None else f"{value:z.3g}" if isinstance(value, float) else str(value)
    return text.replace("|", r"\|")


def _line(curve: Curve, layers: Sequence[str], before: int) -> rr.SeriesLines:
    """Curves of a layer share its colour and differ in opacity. before: number of earlier curves of the layer."""
    count = layers.count(curve.layer)
    names = list(dict.fromkeys(layer for layer in layers if layer))
    hue = colour(curve.layer, names) if curve.layer else NEUTRAL_COLOUR
    return line(hue, 1.5, curve.name, opacity=np.linspace(1.0, 0.4, count)[before : before + 1])


def _bands(diagnostic: Diagnostic) -> dict[str, NDArray[np.bool_]]:
    """Bands with at least one step."""
    return {kind: mask for kind, mask in diagnostic.bands().items() if mask.any()}


def _log_band(stream: rr.RecordingStream | None, path: str, kind: str, mask: NDArray[np.bool_], trace: Trace) -> None:
    """Log the steps at which a band begins and ends; step 0 first."""
    steps = np.flatnonzero(np.concatenate([[True], mask[1:] != mask[:-1]]))
    hue = rgba(BAND_COLOURS.get(kind, NEUTRAL_COLOUR))
    style = rr.StateConfiguration(values=["no", kind], colors=np.full(2, hue, np.uint32), visible=[False, True])
    rr.log(path, style, static=True, recording=stream)
    changes = rr.StateChange.columns(state=[kind if mask[step] else "no" for step in steps])
    rr.send_columns(path, time_columns(trace.episode, steps), changes, recording=stream)
