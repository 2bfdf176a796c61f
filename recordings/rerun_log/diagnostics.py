"""A diagnostic as Rerun paths, and their layout: what the page and a figure show of it, in a recording."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnostics.base import Curve, Diagnostic, Picture, Plot, Table, Value
from beliefscope.inspect.diagnostics.plotting import charts_of, png_of
from beliefscope.inspect.palette import colour
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.rerun_log.entities import line, rgba, series, time_columns

COLOUR_OF_NOTHING = "#9A9A9A"
"""Of curves that belong to no layer, and of bounds."""

HEIGHT, WORDS, AXIS, LANE, LEAST = 800.0, 230.0, 56.0, 41.0, 110.0
"""Points: of a tab in a window of common size, of its words, of the kinds of steps' axis and of each, of a chart."""

COLOURS_OF_BANDS = {"contact": "#CC79A7", "blackout": "#808080", "edit": "#0072B2"}


def log_diagnostic(stream: rr.RecordingStream | None, diagnostic: Diagnostic, name: str, trace: Trace) -> None:
    """Logs what is shown of a diagnostic under ``diagnostics/{name}``; docs/recordings.md has the paths.

    Args:
        stream: where to; None for Rerun's current one, as ``rr.log`` does.
        name: as in ``DIAGNOSTICS``, whose title and question are then told, or any other.
        trace: of whose steps the curves are. A diagnostic of several traces has none.

    Raises:
        BadInput: the curves have another number of steps than the trace.
    """
    root = f"diagnostics/{slug(name)}"
    rr.log(
        f"{root}/about",
        rr.TextDocument(told(diagnostic, name), media_type="text/markdown"),
        static=True,
        recording=stream,
    )
    times = time_columns(np.arange(len(trace)), trace.episode.dt)
    for chart, curves in charts_of(diagnostic):
        layers = [curve.layer for curve in curves]
        for i, curve in enumerate(curves):
            if len(curve.values) != len(trace):
                raise BadInput(
                    f"{name} has curves of {len(curve.values)} steps and the trace has {len(trace)}: "
                    "log it with the trace that it is of"
                )
            path = f"{root}/curves/{slug(chart)}/{slug(curve.name)}"
            rr.log(path, _line(curve, layers, layers[:i].count(curve.layer)), static=True, recording=stream)
            rr.send_columns(path, times, series(curve.values), recording=stream)
        bounds = sorted({one for curve in curves if curve.bounds for one in curve.bounds if np.isfinite(one)})
        if bounds:
            path = f"{root}/bounds/{slug(chart)}"
            ends = np.unique([0, len(trace) - 1])
            rr.log(
                path,
                line(COLOUR_OF_NOTHING, 0.8, *["bounds"] * len(bounds)),
                static=True,
                recording=stream,
            )
            rr.send_columns(
                path,
                time_columns(ends, trace.episode.dt),
                series(np.tile(np.array(bounds), (len(ends), 1))),
                recording=stream,
            )
    for kind, mask in _bands(diagnostic).items():
        _log_band(stream, f"{root}/bands/{slug(kind)}", kind, mask, trace)
    for where, panels in (("plots", diagnostic.plots()), ("pictures", diagnostic.pictures())):
        for panel in panels:
            image = rr.EncodedImage(contents=png_of(panel), media_type="image/png")
            rr.log(f"{root}/{where}/{slug(panel.title)}", image, static=True, recording=stream)


def diagnostic_tab(diagnostic: Diagnostic, name: str) -> rrb.Container:
    """The layout of what ``log_diagnostic`` logs: words, plots and pictures above, the curves below."""
    root = f"diagnostics/{slug(name)}"
    panels: list[tuple[str, Plot | Picture]] = [
        *(("plots", plot) for plot in diagnostic.plots()),
        *(("pictures", picture) for picture in diagnostic.pictures()),
    ]
    said = [
        rrb.TextDocumentView(origin=f"{root}/about", name="What it says"),
        *(rrb.Spatial2DView(origin=f"{root}/{where}/{slug(p.title)}", name=p.title) for where, p in panels),
    ]
    rows: list[rrb.View | rrb.Container] = [rrb.Tabs(*said, active_tab=0)]
    heights = [WORDS]
    linked = rrb.TimeAxis(link="LinkToGlobal")
    charts, bands = charts_of(diagnostic), _bands(diagnostic)
    if charts and bands:
        rows.append(rrb.StateTimelineView(origin=f"{root}/bands", name="Steps", time_view=linked))
        heights.append(AXIS + LANE * len(bands))
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
    heights += [max(LEAST, (HEIGHT - sum(heights)) / len(charts))] * len(charts) if charts else []
    return rrb.Vertical(*rows, row_shares=heights, name=title_of(name))


def title_of(name: str) -> str:
    """The title of a diagnostic of the catalog; any other's is its name."""
    return DIAGNOSTICS[name].title if name in DIAGNOSTICS else name


def slug(name: str) -> str:
    """A name as one part of a path: letters and digits in lower case, with ``_`` for what lies between them."""
    return re.sub(r"\W+", "_", name.lower()).strip("_") or "_"


def told(diagnostic: Diagnostic, name: str) -> str:
    """Title, question, verdict and tables as Markdown, with a last one of what its curves are."""
    question = [f"*{DIAGNOSTICS[name].question}*"] if name in DIAGNOSTICS else []
    tables = diagnostic.tables()
    if curves := diagnostic.curves():
        rows = [(one.chart, one.name, one.unit, *(one.bounds or (None, None))) for one in curves]
        tables = [*tables, Table("Curves", ("chart", "curve", "unit", "should be from", "to"), tuple(rows))]
    return "\n\n".join([f"# {title_of(name)}", *question, diagnostic.verdict, *map(_table, tables)]) + "\n"


def _table(table: Table) -> str:
    rows = [table.columns, ["---"] * len(table.columns), *([_cell(value) for value in row] for row in table.rows)]
    return "\n".join([f"## {table.title}", "", *(f"| {' | '.join(row)} |" for row in rows)])


def _cell(value: Value) -> str:
    text = "-" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)
    return text.replace("|", r"\|")


def _line(curve: Curve, layers: Sequence[str], before: int) -> rr.SeriesLines:
    """Curves of one layer share its colour and tell apart by their strength; ``before``: how many came before."""
    count = layers.count(curve.layer)
    named = list(dict.fromkeys(one for one in layers if one))
    hue = colour(curve.layer, named) if curve.layer else COLOUR_OF_NOTHING
    return line(hue, 1.5, curve.name, opacity=np.linspace(1.0, 0.4, count)[before : before + 1])


def _bands(diagnostic: Diagnostic) -> dict[str, NDArray[np.bool_]]:
    """Those that some step is of."""
    return {kind: mask for kind, mask in diagnostic.bands().items() if mask.any()}


def _log_band(stream: rr.RecordingStream | None, path: str, kind: str, mask: NDArray[np.bool_], trace: Trace) -> None:
    """Where it begins and ends, step 0 first."""
    steps = np.flatnonzero(np.concatenate([[True], mask[1:] != mask[:-1]]))
    hue = rgba(COLOURS_OF_BANDS.get(kind, COLOUR_OF_NOTHING))
    looks = rr.StateConfiguration(values=["no", kind], colors=np.full(2, hue, np.uint32), visible=[False, True])
    rr.log(path, looks, static=True, recording=stream)
    changes = rr.StateChange.columns(state=[kind if mask[step] else "no" for step in steps])
    rr.send_columns(path, time_columns(steps, trace.episode.dt), changes, recording=stream)
