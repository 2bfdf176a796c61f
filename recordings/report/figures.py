"""Figures of a report: the error of each run with marked events, and the details of one event."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import patheffects, rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from beliefscope.datasets.task import with_unit
from beliefscope.inspect.diagnostics.plotting import STYLE, WIDTH, StepAxis, draw_bands, draw_legend, legend_height
from beliefscope.inspect.maps.map_engine import LikelihoodMap
from beliefscope.inspect.maps.plane import axis_titles, plane_of
from beliefscope.inspect.palette import COLOURS, colour
from beliefscope.inspect.statistics import measures
from beliefscope.inspect.trace import Trace
from beliefscope.inspect.traces.sensors import displayed_sensors

COLUMNS = 4
"""Maximum number of panels per row."""

LEGEND = 1.5
"""Inches of the legend beside estimates without a map."""

ZOOMS = (6, 4, 2)
MIN_SHARE = 0.98
"""Minimum fraction of each layer's likelihood inside a zoomed map."""

EDGE = [patheffects.withStroke(linewidth=2.6, foreground="white")]


def zoom_of(map_: LikelihoodMap) -> int:
    """Largest zoom of a map that still contains ``MIN_SHARE`` of the likelihood of every layer."""
    share = np.exp(map_.log_likelihood - map_.log_likelihood.max(axis=(1, 2), keepdims=True)).astype(np.float64)
    share /= share.sum(axis=(1, 2), keepdims=True)
    for zoom in ZOOMS:
        x, y = (np.abs(o) <= np.abs(o).max() / zoom for o in (map_.offsets_x, map_.offsets_y))
        if (share[:, y][:, :, x].sum(axis=(1, 2)) >= MIN_SHARE).all():
            return zoom
    return 1


def error_figure(traces: Sequence[Trace], marks: Mapping[int, Sequence[tuple[int, str]]]) -> Figure:
    """Position error of each layer over the steps, or over their times if the data have them, one chart per trace.

    Args:
        marks: index in ``traces`` -> (step, name) of marked events.
    """
    with rc_context(STYLE):
        labels = [*map(measures.layer_label, measures.layers(traces[0])), "contact", "blackout"]
        height = 1.55 + legend_height(labels, "episode 0")
        figure = Figure(figsize=(WIDTH, height * len(traces) + 0.3), layout="constrained")
        FigureCanvasAgg(figure)
        charts = figure.subplots(len(traces), 1, squeeze=False)[:, 0]
        for index, (axes, trace) in enumerate(zip(charts, traces, strict=True)):
            main, axis = trace.task.main_error, StepAxis.from_times(len(trace), trace.episode.time)
            error = main.factor * measures.main_error(trace)
            for layer, values in zip(measures.layers(trace), error.T, strict=True):
                if layer == "fused" or layer in trace.modalities_with_posterior:
                    style = {"lw": 1.5, "zorder": 2.5} if layer == "fused" else {"lw": 0.9}
                    shade = colour(layer, trace.modalities)
                    axes.plot(axis.positions, values, label=measures.layer_label(layer), color=shade, **style)
            bands = {"contact": trace.episode.contact.astype(bool), "blackout": measures.blackout(trace)}
            draw_bands(axes, bands, axis, labelled=True)
            for step, name in marks.get(index, ()):
                axes.axvline(axis.positions[step], color="black", lw=0.6, ls=":")
                place = {"xytext": (2, -1), "textcoords": "offset points", "va": "top", "fontsize": 7}
                axes.annotate(name, (axis.positions[step], 1.0), xycoords=axes.get_xaxis_transform(), **place)
            axes.set_ylabel(with_unit(f"{main.name} error", main.unit))
            axes.set_xlim(axis.edges[0], axis.edges[-1])
            if trace is traces[-1] or any(other.episode.time is None for other in traces) == (axis.label != "step"):
                axes.set_xlabel(axis.label)
            axes.set_ylim(0.0, 1.15 * float(np.max(error[np.isfinite(error)], initial=0.0)) or 1.0)
            draw_legend(axes, f"episode {trace.episode_index}")
    return figure


def event_figure(trace: Trace, step: int, map_: LikelihoodMap | None, zoom: int = 1) -> Figure:
    """Inputs of the filter (``displayed_sensors``), and maps and estimates at a step as offsets from the true position.

    Arrays are in colours over the range of the run.

    Args:
        map_: None to show the estimates only.
        zoom: magnification of the map.
    """
    images = [sensor for sensor in displayed_sensors(trace) if not sensor.points]
    layers = map_.layers if map_ is not None else ("estimates",)
    count = len(images) + len(layers)
    columns = min(COLUMNS, count)
    rows = -(-count // columns)
    with rc_context(STYLE):
        beside = LEGEND if map_ is None and len(trace.task.map_indices) == 2 else 0.0
        figure = Figure(figsize=(WIDTH * columns / COLUMNS + beside, 2.05 * rows), layout="constrained")
        FigureCanvasAgg(figure)
        grid = list(figure.subplots(rows, columns, squeeze=False).flat)
        for axes, sensor in zip(grid, images, strict=False):
            image, levels = trace.episode.observations[sensor.name][step], {"cmap": "gray", "vmin": 0, "vmax": 255}
            if sensor.low is not None:
                levels = {"cmap": "viridis", "vmin": sensor.low, "vmax": sensor.high}
            axes.imshow(image, interpolation="nearest", **levels)
            axes.set(xticks=[], yticks=[])
            lost = sensor.low is None and not image.any()
            axes.set_title(sensor.name + (", blackout" if lost else ""), loc="left", fontsize=7.5)
        for i, layer in enumerate(layers):
            index = len(images) + i
            _draw_layer(grid[index], trace, step, map_, layer, zoom)
            if i > 0 and index % columns > 0:
                grid[index].set_ylabel("")
        for axes in grid[count:]:
            axes.set_visible(False)
    return figure


def _draw_layer(axes: Axes, trace: Trace, step: int, map_: LikelihoodMap | None, layer: str, zoom: int) -> None:
    """Draw a layer's map with its estimate, or without a map the estimates of all layers."""
    task = trace.task
    where = list(task.map_indices)
    titles, factors = zip(*axis_titles(task, where), strict=True)
    half = np.array(plane_of(trace).half_widths) * factors
    offsets = task.difference(measures.means(trace)[step], trace.anchors[step])[:, where] * factors
    positions = dict(zip(measures.layers(trace), offsets, strict=True))
    if len(where) == 1:
        _draw_curve(axes, trace, positions, map_, layer, factors[0])
    elif map_ is None:
        axes.axhline(0.0, color=COLOURS["truth"], lw=0.6)
        axes.axvline(0.0, color=COLOURS["truth"], lw=0.6)
        for name in (*trace.modalities_with_posterior, "fused"):
            _draw_estimate(axes, positions[name], colour(name, trace.modalities), name)
        axes.legend(frameon=False, fontsize=6, loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0)
    else:
        log = map_.log_likelihood[map_.layers.index(layer)]
        style: dict[str, Any] = {
            "cmap": "viridis",
            "vmin": 0.0,
            "vmax": 1.0,
            "origin": "lower",
            "extent": (-half[0], half[0], -half[1], half[1]),
            "aspect": "auto",
        }
        axes.imshow(np.exp(log - log.max()), interpolation="nearest", **style)
        hair = np.array([-1.0, -0.15 / zoom, np.nan, 0.15 / zoom, 1.0])
        for x, y in ((half[0] * hair, [0.0] * 5), ([0.0] * 5, half[1] * hair)):
            axes.plot(x, y, color="white", lw=0.5, alpha=0.7)
        if layer == "fused" or layer in trace.modalities_with_posterior:
            _draw_estimate(axes, positions[layer], colour(layer, trace.modalities), layer)
    axes.set(xlim=(-half[0] / zoom, half[0] / zoom), xlabel=titles[0])
    if len(where) == 2:
        same = task.components[where[0]].unit == task.components[where[1]].unit
        axes.set(ylim=(-half[1] / zoom, half[1] / zoom), ylabel=titles[1], aspect="equal" if same else "auto")
    axes.set_title(layer if map_ is None else f"{layer} {map_.quantity}", loc="left", fontsize=7.5)


def _draw_curve(
    axes: Axes, trace: Trace, positions: Mapping[str, Any], map_: LikelihoodMap | None, layer: str, factor: float
) -> None:
    """Draw a layer's map over one component relative to its maximum, and lines at the truth and the estimates."""
    axes.axvline(0.0, color=COLOURS["truth"], lw=0.8)
    if map_ is not None:
        log = map_.log_likelihood[map_.layers.index(layer), 0]
        axes.plot(factor * map_.offsets_x, np.exp(log - log.max()), color=colour(layer, trace.modalities), lw=1.2)
    layers = (*trace.modalities_with_posterior, "fused")
    for name in layers if map_ is None else {layer} & {*layers}:
        axes.axvline(positions[name][0], color=colour(name, trace.modalities), lw=0.8, ls="--")
    axes.set(ylim=(0.0, 1.05), yticks=[])


def _draw_estimate(axes: Axes, position: np.ndarray, hue: str, name: str) -> None:
    """Draw a ring, which leaves the map below visible."""
    style: dict[str, Any] = {"marker": "o", "ms": 7, "mfc": "none", "mec": hue, "mew": 1.3, "ls": ""}
    axes.plot(*position, label=measures.layer_label(name), path_effects=EDGE, zorder=4, **style)
