"""Figures that only a report has: the error of each run with the chosen moments, and one moment at a glance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import patheffects, rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from beliefscope.inspect.diagnostics.plotting import STYLE, WIDTH, draw_bands
from beliefscope.inspect.likelihood import LikelihoodMap
from beliefscope.inspect.palette import COLOURS, colour
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace

A_ROW = 4
"""Panels of a moment side by side."""

ZOOMS = (6, 4, 2)
HELD = 0.98
"""Share of each layer's likelihood that the middle of a map holds, for the rest to be left out."""

EDGE = [patheffects.withStroke(linewidth=2.6, foreground="white")]


def zoom_of(map_: LikelihoodMap) -> int:
    """How many times narrower than the map the middle is that holds nearly all that every layer finds likely."""
    share = np.exp(map_.log_likelihood - map_.log_likelihood.max(axis=(1, 2), keepdims=True)).astype(np.float64)
    share /= share.sum(axis=(1, 2), keepdims=True)
    for zoom in ZOOMS:
        x, y = (np.abs(offsets) <= np.abs(map_.offsets_x).max() / zoom for offsets in (map_.offsets_x, map_.offsets_y))
        if (share[:, y][:, :, x].sum(axis=(1, 2)) >= HELD).all():
            return zoom
    return 1


def error_figure(traces: Sequence[Trace], marks: Mapping[int, Sequence[tuple[int, str]]]) -> Figure:
    """Position error of each layer over the steps, one chart a trace.

    Args:
        marks: index in ``traces`` -> (step, name) of the moments that are marked in it.
    """
    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH, 1.55 * len(traces) + 0.3), layout="constrained")
        FigureCanvasAgg(figure)
        charts = figure.subplots(len(traces), 1, squeeze=False)[:, 0]
        for index, (axes, trace) in enumerate(zip(charts, traces, strict=True)):
            error = 100.0 * measures.position_error(trace)
            for layer, values in zip(measures.layers(trace), error.T, strict=True):
                if layer == "fused" or layer in trace.alone:
                    look = {"lw": 1.5, "zorder": 2.5} if layer == "fused" else {"lw": 0.9}
                    axes.plot(values, label=layer, color=colour(layer, trace.modalities), **look)
            bands = {"contact": trace.episode.contact.astype(bool), "blackout": measures.blackout(trace)}
            draw_bands(axes, bands, named=True)
            for step, name in marks.get(index, ()):
                axes.axvline(step, color="black", lw=0.6, ls=":")
                place = {"xytext": (2, -1), "textcoords": "offset points", "va": "top", "fontsize": 7}
                axes.annotate(name, (step, 1.0), xycoords=axes.get_xaxis_transform(), **place)
            axes.set_title(f"episode {trace.episode_index}", loc="left")
            axes.set_ylabel("position error (cm)")
            axes.set_xlim(-0.5, len(trace) - 0.5)
            axes.set_ylim(0.0, 1.15 * float(np.nanmax(error)) or 1.0)
            axes.legend(frameon=False, ncols=6, loc="lower right", bbox_to_anchor=(1.0, 0.97), borderaxespad=0.0)
        charts[-1].set_xlabel("step")
    return figure


def moment_figure(trace: Trace, step: int, map_: LikelihoodMap | None, zoom: int = 1) -> Figure:
    """The pictures that the filter was given and each layer's map, its own estimate upon it; all offsets are from the
    truth. Without maps: where the estimates are.

    Args:
        zoom: how many times narrower than the map the square is that is drawn.
    """
    task = measures.task_of(trace)
    pictures = {key: one[step] for key, one in trace.episode.observations.items() if one.ndim == 3}
    layers = map_.layers if map_ is not None else ("estimates",)
    count = len(pictures) + len(layers)
    columns = min(A_ROW, count)
    rows = -(-count // columns)
    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH * columns / A_ROW, 2.05 * rows), layout="constrained")
        FigureCanvasAgg(figure)
        grid = list(figure.subplots(rows, columns, squeeze=False).flat)
        for axes, (key, picture) in zip(grid, pictures.items(), strict=False):
            axes.imshow(picture, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
            axes.set(xticks=[], yticks=[])
            axes.set_title(key + (", black" if not picture.any() else ""), loc="left", fontsize=7.5)
        half = 100.0 * task.map_half_width
        centre = trace.episode.states[step][list(task.map_indices)]
        offsets = 100.0 * (measures.means(trace)[step][:, list(task.map_indices)] - centre)
        where = dict(zip(measures.layers(trace), offsets, strict=True))
        first = len(pictures)
        for i, layer in enumerate(layers):
            axes = grid[first + i]
            if map_ is None:
                axes.axhline(0.0, color=COLOURS["truth"], lw=0.6)
                axes.axvline(0.0, color=COLOURS["truth"], lw=0.6)
                for name in (*trace.alone, "fused"):
                    _estimate(axes, where[name], colour(name, trace.modalities), name)
                axes.legend(frameon=False, fontsize=6)
            else:
                log = map_.log_likelihood[i]
                extent = (-half, half, -half, half)
                look = {"cmap": "viridis", "vmin": 0.0, "vmax": 1.0, "origin": "lower", "extent": extent}
                axes.imshow(np.exp(log - log.max()), interpolation="nearest", **look)
                hair = [-half, -0.15 * half / zoom, np.nan, 0.15 * half / zoom, half]
                for x, y in ((hair, [0.0] * 5), ([0.0] * 5, hair)):
                    axes.plot(x, y, color="white", lw=0.5, alpha=0.7)
                if layer == "fused" or layer in trace.alone:
                    _estimate(axes, where[layer], colour(layer, trace.modalities), layer)
            axes.set(xlim=(-half / zoom, half / zoom), ylim=(-half / zoom, half / zoom), aspect="equal")
            axes.set_title(layer, loc="left", fontsize=7.5)
            axes.set_xlabel(f"{task.map_components[0].replace('_', ' ')} offset (cm)")
            if i == 0 or (first + i) % columns == 0:
                axes.set_ylabel(f"{task.map_components[1].replace('_', ' ')} offset (cm)")
        for axes in grid[count:]:
            axes.set_visible(False)
    return figure


def _estimate(axes: Axes, place: np.ndarray, shade: str, name: str) -> None:
    """A ring, so that what lies beneath is seen."""
    axes.plot(*place, marker="o", ms=7, mfc="none", mec=shade, mew=1.3, ls="", label=name, path_effects=EDGE, zorder=4)
